"""An unforeseen error is told with the line of whoever made the mistake, not of the library it ended in."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from morpheyes_daemon.errors import mistake


@pytest.mark.parametrize(
    ("slip", "says"),
    [
        (lambda: dict[str, int]()["nothing"], "KeyError: 'nothing'"),
        (lambda: json.loads("{"), "JSONDecodeError: "),
        (lambda: np.linalg.inv(np.zeros((2, 2))), "LinAlgError: Singular matrix"),
    ],
)
def test_a_mistake_is_told_with_the_last_line_before_libraries(slip: Callable[[], object], says: str) -> None:
    with pytest.raises(Exception) as raised:
        slip()
    told = mistake(raised.value)
    assert told.startswith(says)
    assert told.endswith(f"(test_errors.py:{slip.__code__.co_firstlineno})")
