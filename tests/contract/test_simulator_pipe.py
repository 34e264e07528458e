"""The pipe between a real-time flight and its simulator: what is larger than the pipe arrives whole."""

import multiprocessing
import threading
from types import SimpleNamespace

from morpheyes_daemon.daemon.service import real_time_runner
from morpheyes_daemon.flights.realtime import Simulator
from morpheyes_daemon.flights.simulator_process import Ready


def test_a_scene_larger_than_the_pipe_arrives_whole() -> None:
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    ready = Ready("tcp:127.0.0.1:5760", "serial:/dev/null:115200", "x" * 5_000_000)
    sender = threading.Thread(target=theirs.send, args=(ready,))

    async def receive() -> Ready:
        simulator = Simulator(SimpleNamespace(exitcode=None, join=lambda timeout: None), ours, lambda seen: None)
        sender.start()
        return await simulator.get_ready()

    with real_time_runner() as runner:
        assert runner.run(receive()) == ready
    sender.join()
    ours.close()
    theirs.close()
