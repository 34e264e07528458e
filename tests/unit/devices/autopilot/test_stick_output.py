"""Sticks to radio channels: RCMAP decides, and before it is known there are only releases."""

from __future__ import annotations

import pytest

from morpheyes_daemon.devices.autopilot.stick_output import ChannelMap, StickOutput
from morpheyes_daemon.errors import DeviceError
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.wire.mavlink import RELEASE, ChannelOverride
from tests.support.copter_parameters import copter_parameters

STICKS = GateOutput(0, State.ENGAGED, Action.STICKS, None, 1501, 1502, 1503, 1504)


def test_sticks_go_out_on_the_channels_that_the_autopilot_maps() -> None:
    sent: list[ChannelOverride] = []
    output = StickOutput(sent.append)
    output.set_channel_map(ChannelMap.from_parameters(copter_parameters(RCMAP_ROLL=4.0, RCMAP_YAW=1.0)))
    output(STICKS)
    assert sent == [ChannelOverride((1504, 1502, 1503, 1501))]


def test_without_a_channel_map_everything_is_a_release() -> None:
    sent: list[ChannelOverride] = []
    StickOutput(sent.append)(STICKS)
    assert sent == [RELEASE]


def test_a_release_needs_no_channel_map_and_ignores_widths() -> None:
    sent: list[ChannelOverride] = []
    output = StickOutput(sent.append)
    output.set_channel_map(ChannelMap((1, 2, 3, 4)))
    output(GateOutput(0, State.PILOT, Action.RELEASE, None, 1501, 1502, 1503, 1504))
    assert sent == [RELEASE]


@pytest.mark.parametrize("changes", [{"RCMAP_ROLL": 2.0}, {"RCMAP_YAW": 5.0}])
def test_sticks_elsewhere_than_on_channels_1_to_4_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(DeviceError, match="channels 1 to 4"):
        ChannelMap.from_parameters(copter_parameters(**changes))


def test_a_missing_parameter_is_named() -> None:
    parameters = copter_parameters()
    del parameters["RCMAP_PITCH"]
    with pytest.raises(DeviceError, match="RCMAP_PITCH"):
        ChannelMap.from_parameters(parameters)
