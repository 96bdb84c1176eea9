"""How old packets are when a loop decides by them."""

from elpd.focus.delays import REMEMBERED, TO_HOST, TO_LOOP, Delays
from elpd.units import HostNs


def test_each_way_is_told_in_microseconds_and_only_the_newest_are_kept() -> None:
    delays = Delays()
    assert delays.by_stage() == {}
    for k in range(REMEMBERED + 10):
        delays.received(HostNs(1_000_000), HostNs(1_000_000 + 1000 * k))
    delays.taken(HostNs(5_000), HostNs(12_000))
    told = delays.by_stage()
    assert (len(told[TO_HOST]), told[TO_HOST][0], told[TO_HOST][-1]) == (REMEMBERED, 10.0, REMEMBERED + 9.0)
    assert told[TO_LOOP] == (7.0,)


def test_a_packet_that_seems_to_come_from_the_future_came_at_once() -> None:
    delays = Delays()
    delays.received(HostNs(10), HostNs(5))
    assert delays.by_stage()[TO_HOST] == (0.0,)
