"""Reading ahead: in order, errors in their place, a bounded number of items alive, no thread left behind."""

from __future__ import annotations

import contextlib
import gc
import threading
import time
import weakref

import pytest

from semstab.core.background import Background
from semstab.core.prefetch import prefetch
from semstab.errors import DataError


def readers() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("semstab-read")]


@pytest.fixture(autouse=True)
def _no_thread_stays():
    yield
    assert readers() == []


class Item:
    def __init__(self, index: int) -> None:
        self.index = index


@pytest.mark.parametrize("threads", [1, 2, 4, None])
def test_items_come_in_the_order_of_the_indices(threads) -> None:
    def read(index: int) -> int:
        time.sleep(0.002 * (index % 3))  # later ones are often ready first
        return index * index

    indices = [7, 0, 5, 3, 3, 9, 1, 2]
    fetched = list(prefetch(read, indices, threads=threads))
    assert [item.item for item in fetched] == [index * index for index in indices]
    assert all(item.seconds >= 0 and item.waited >= 0 for item in fetched)
    assert list(prefetch(read, [], threads=threads)) == []


@pytest.mark.parametrize("threads", [1, 4])
@pytest.mark.parametrize("bad", [0, 3, 9])
def test_an_error_is_raised_in_its_place(threads, bad) -> None:
    """After the items before it, although the workers met it earlier; and the first of several."""

    def read(index: int) -> int:
        time.sleep(0 if index >= bad else 0.005)
        if index >= bad:
            raise DataError(f"depth/{index}.png: damaged")
        return index

    items = []

    def consume() -> None:
        for fetched in prefetch(read, range(10), threads=threads):
            items.append(fetched.item)

    with pytest.raises(DataError, match=f"^depth/{bad}.png: damaged$"):
        consume()
    assert items == list(range(bad))


@pytest.mark.parametrize(("threads", "size", "most"), [(1, 0, 4), (3, 0, 6), (3, 60, 3), (3, 1000, 3), (3, 30, 5)])
def test_few_items_are_alive_whatever_the_length(threads, size, most) -> None:
    """Those ahead, bounded in number and bytes (limit 100), the one in hand, and the one before it."""
    alive: weakref.WeakSet[Item] = weakref.WeakSet()
    lock = threading.Lock()

    def read(index: int) -> Item:
        item = Item(index)
        with lock:
            alive.add(item)
        return item

    counts = []
    before = None
    for fetched in prefetch(read, range(200), threads=threads, size=lambda item: size, limit=100):
        time.sleep(0.0005)  # the workers get ahead as far as they may
        counts.append(len(alive))
        before = fetched
    del fetched, before
    gc.collect()
    assert max(counts[2:]) <= most
    assert len(alive) == 0


def test_closing_drops_what_was_not_begun() -> None:
    begun = []

    def read(index: int) -> int:
        begun.append(index)
        time.sleep(0.01)
        return index

    def work() -> None:
        with contextlib.closing(prefetch(read, range(1000), threads=2)) as items:
            assert next(items).item == 0
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert readers() == []
    assert len(begun) <= 4


def test_workers_run_while_the_caller_works() -> None:
    """Waiting (sleeping) workers and caller overlap: 10 x (20 + 20) ms of work in clearly less."""

    def read(index: int) -> int:
        time.sleep(0.02)
        return index

    started = time.perf_counter()
    for _ in prefetch(read, range(10), threads=2):
        time.sleep(0.02)
    assert time.perf_counter() - started < 0.36


def test_jobs_are_done_in_order_and_errors_raised_where_they_are_waited_for() -> None:
    done, jobs = list[int](), Background("beside", 2)
    for number in range(10):
        jobs.submit(lambda number=number: done.append(number))  # type: ignore[misc]
        assert number - len(done) <= 2
    jobs.drain()
    assert done == [*range(10)]
    jobs.submit(lambda: done.remove(-1))
    with pytest.raises(ValueError, match="not in list"):
        jobs.close()
