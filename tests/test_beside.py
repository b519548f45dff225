"""What a command puts together while others do the work."""

from __future__ import annotations

import threading

import pytest

from semstab.engine.tiled_units import Beside
from semstab.errors import DataError


def test_beside_others_nobody_waits_for_it():
    begun, others_done = threading.Event(), threading.Event()

    def put_together() -> str:
        begun.set()
        return "whole" if others_done.wait(10) else "never"

    found = Beside(threaded=True).submit(put_together)
    assert begun.wait(10)
    assert not found.done()
    others_done.set()
    assert found.result() == "whole"


def test_alone_it_is_done_at_once():
    assert Beside().submit(lambda: 3).done()


@pytest.mark.parametrize("threaded", [False, True])
def test_what_is_wrong_with_the_data_is_raised_where_the_result_is_wanted(threaded):
    def broken() -> None:
        raise DataError("part 3 is gone")

    found = Beside(threaded=threaded).submit(broken)
    with pytest.raises(DataError, match="part 3 is gone"):
        found.result()
