"""What ground stations and the autopilot's log hear of a moving object: the real daemon on a link that is listened to."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import S, run_virtual
from morpheyes_daemon.config.vehicle import MissionFile, NoServoConfig
from morpheyes_daemon.messages.core import Perception, Track
from morpheyes_daemon.strategies.imo.strategy import ImoPercept
from tests.safety.noisy_daemon import NoisyDaemon
from tests.support.seen_from_above import SUMMARY, empty_profile

ACTED_ON = {"LANDING_TARGET", "FOLLOW_TARGET", "OBSTACLE_DISTANCE_3D"}


def track(seen: bool) -> Track:
    """An object 6 m ahead and 1 m to the left, 2 m up, coming; one sigma of 0.3, 0.4 and 1.2 m along the axes."""
    covariance = np.diag([0.3**2, 0.4**2, 1.2**2, 9.0, 9.0, 9.0])
    place, velocity = (6.0, -1.0, -2.0), (-0.75, 0.25, 0.125)
    return Track(1, 10 * S, 7, seen, place, velocity, covariance, (-1.0, 0.5, 5.875), 0.15, 400, 0.2)


def said_of(followed: Track | None) -> list[Any]:
    """Every message that the daemon sends in the second after a frame that shows `followed`."""
    heard: list[Any] = []

    async def life() -> None:
        async with NoisyDaemon(NoServoConfig(backend="none"), MissionFile(strategy="imo")) as noisy:
            link, parser = noisy.links["autopilot"], mavlink.MAVLink(None)
            count = len(link.sent)
            percept = ImoPercept(followed, 40, 5, empty_profile())
            seen = Perception(SUMMARY, percept, np.full(72, np.nan, np.float32))
            noisy.daemon.topics.perception.publish(seen)
            await noisy.pass_time(1.0)
            assert noisy.daemon.topics.command.get() is not None
            heard.extend(message for data in link.sent[count:] for message in parser.parse_buffer(data) or [])

    run_virtual(life())
    return heard


def of_the_object(heard: list[Any]) -> dict[str, Any]:
    return {message.name: message for message in heard if getattr(message, "name", "").startswith("me_obj")}


def test_a_tracked_object_is_told_in_ned_metres_and_metres_per_second() -> None:
    heard = said_of(track(seen=True))
    told = of_the_object(heard)
    assert set(told) == {"me_obj_p", "me_obj_v", "me_obj_z", "me_obj_sd"}
    place, velocity = told["me_obj_p"], told["me_obj_v"]
    assert place.get_type() == velocity.get_type() == "DEBUG_VECT"
    assert (place.x, place.y, place.z) == (6.0, -1.0, -2.0)
    assert (velocity.x, velocity.y, velocity.z) == (-0.75, 0.25, 0.125)
    assert told["me_obj_z"].get_type() == told["me_obj_sd"].get_type() == "NAMED_VALUE_FLOAT"
    # depth along the left eye's axis; one sigma of the place over all three axes, the velocity's left out
    assert told["me_obj_z"].value == 5.875
    assert told["me_obj_sd"].value == pytest.approx(1.3)
    assert {(message.get_srcSystem(), message.get_srcComponent()) for message in told.values()} == {(1, 197)}
    assert not ACTED_ON & {message.get_type() for message in heard}


def test_an_object_out_of_sight_goes_on_being_told_without_a_depth() -> None:
    told = of_the_object(said_of(track(seen=False)))
    assert (told["me_obj_p"].x, told["me_obj_p"].y, told["me_obj_p"].z) == (6.0, -1.0, -2.0)
    assert math.isnan(told["me_obj_z"].value)


def test_nothing_is_told_while_nothing_is_tracked() -> None:
    heard = said_of(None)
    assert not of_the_object(heard)
    assert "DEBUG_VECT" not in {message.get_type() for message in heard}
