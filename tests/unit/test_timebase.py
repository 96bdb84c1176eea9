import random
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from elpd.timebase import SensorClock
from elpd.units import HostNs, SensorUs


def test_the_offset_is_that_of_the_fastest_packet() -> None:
    """Packets are late by queueing; the least late one tells the truth up to the camera's own latency."""
    clock = SensorClock(min_latency_us=150)
    draws = random.Random(1)
    for packet in range(1000):
        sensor_us = 10_000_000 + 500 * packet
        delay_us = 150 + draws.expovariate(1 / 80)
        clock.saw(SensorUs(sensor_us), HostNs(round((sensor_us - 9_000_000 + delay_us) * 1000)))
    assert abs(clock.to_host(SensorUs(10_500_000)) - 1_500_000_000) < 2_000
    assert clock.to_sensor(clock.to_host(SensorUs(10_400_123))) == 10_400_123


def test_a_drifting_crystal_is_followed() -> None:
    clock = SensorClock(window_ns=1_000_000_000)
    drift = 50e-6
    for packet in range(20_000):
        sensor_us = 500 * packet
        clock.saw(SensorUs(sensor_us), HostNs(round(sensor_us * 1000 * (1 + drift))))
    last_us = 500 * 19_999
    assert abs(clock.to_host(SensorUs(last_us)) - last_us * 1000 * (1 + drift)) <= drift * 1e9 + 1


def test_an_unknown_clock_says_so() -> None:
    clock = SensorClock()
    assert not clock.known
    with pytest.raises(ValueError, match="first packet"):
        clock.to_host(SensorUs(0))
    clock.saw(SensorUs(5), HostNs(5000))
    assert clock.known
    clock.restart()
    assert not clock.known


LATENCY_US = 150.0


def stream(
    draws: random.Random, drift: float, queueing_us: float, interval_us: int, duration_us: int
) -> Iterator[tuple[int, int]]:
    """Yield sensor us, host ns of packets that queue, and now and then stand still for up to 20 ms, then come at once.

    True host time is ``1 + drift`` times the sensor's.
    """
    held_us = before_us = 0.0
    for t_us in range(interval_us, duration_us, interval_us):
        if draws.random() < 0.01:
            held_us = t_us + draws.uniform(0, 20_000)
        arrived_us = t_us * (1 + drift) + LATENCY_US + draws.expovariate(1 / queueing_us)
        before_us = max(arrived_us, held_us, before_us)
        yield t_us, round(before_us * 1000)


def error_us(clock: SensorClock, t_us: int, drift: float) -> float:
    return abs(clock.to_host(SensorUs(t_us)) / 1000 - t_us * (1 + drift))


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32),
    st.floats(-100e-6, 100e-6),
    st.sampled_from([1, 10, 50, 200, 500]),
    st.sampled_from([500, 1000, 4000]),
)
def test_no_packet_comes_from_the_future_whatever_the_drift_and_the_queues(
    seed: int, drift: float, queueing_us: float, interval_us: int
) -> None:
    clock = SensorClock(LATENCY_US)
    for t_us, received_ns in stream(random.Random(seed), drift, queueing_us, interval_us, 1_500_000):
        clock.saw(SensorUs(t_us), HostNs(received_ns))
        assert clock.to_host(SensorUs(t_us)) <= received_ns - LATENCY_US * 1000 + 1
        assert abs(clock.to_sensor(clock.to_host(SensorUs(t_us))) - t_us) <= 1
    assert error_us(clock, t_us, drift) < 100 + 2 * queueing_us
    assert clock.bound_us < 5 + 8 * max(queueing_us, interval_us / 50)


def test_its_bound_holds_but_once_in_two_hundred_times() -> None:
    draws = random.Random(8)
    outside = looked = 0
    for queueing_us in (1, 10, 50, 200, 500) * 3:
        clock, drift = SensorClock(LATENCY_US), draws.uniform(-100e-6, 100e-6)
        for t_us, received_ns in stream(draws, drift, queueing_us, 1000, 2_000_000):
            clock.saw(SensorUs(t_us), HostNs(received_ns))
            if t_us > 400_000 and t_us % 20_000 == 0:
                looked += 1
                outside += error_us(clock, t_us, drift) > clock.bound_us
    assert looked > 1000
    assert outside <= looked / 200


def test_drift_is_measured() -> None:
    clock = SensorClock(LATENCY_US)
    for t_us, received_ns in stream(random.Random(2), 60e-6, 50, 1000, 4_000_000):
        clock.saw(SensorUs(t_us), HostNs(received_ns))
    assert clock.drift_ppm == pytest.approx(60, abs=2)
    assert error_us(clock, 4_000_000, 60e-6) < 10


@pytest.mark.parametrize("step_ms", [-500.0, -5.0, 5.0, 500.0])
def test_a_step_is_followed(step_ms: float) -> None:
    """Downwards at once; upwards it might be a queue, until that has lasted a second."""
    clock, at_us = SensorClock(LATENCY_US), 2_000_000
    last_us = at_us + (1_300_000 if step_ms > 0 else 100_000)
    for t_us, received_ns in stream(random.Random(4), 20e-6, 30, 1000, last_us):
        clock.saw(SensorUs(t_us), HostNs(received_ns + (0 if t_us < at_us else round(step_ms * 1e6))))
    assert abs(clock.to_host(SensorUs(last_us)) - last_us * 1.00002 * 1000 - step_ms * 1e6) < 20_000


def test_a_queue_that_lasts_is_in_the_bound() -> None:
    clock = SensorClock(LATENCY_US)
    for t_us, received_ns in stream(random.Random(5), 0.0, 10, 1000, 1_500_000):
        clock.saw(SensorUs(t_us), HostNs(received_ns + (800_000 if t_us > 1_000_000 else 0)))
    assert clock.bound_us > 800


def test_a_sensor_that_begins_again_is_a_new_clock() -> None:
    clock = SensorClock()
    for t_us in range(5_000_000, 6_000_000, 1000):
        clock.saw(SensorUs(t_us), HostNs(t_us * 1000))
    clock.saw(SensorUs(10), HostNs(9_000_000_000))
    assert clock.to_host(SensorUs(10)) == 9_000_000_000
    assert clock.bound_us == float("inf")


def test_stamps_of_the_unix_epoch_lose_nothing() -> None:
    """Some libraries stamp with it: 1.8e15 us, where a float of nanoseconds has steps of 256."""
    clock, epoch_us = SensorClock(), 1_795_388_665_467_217
    for t_us in range(0, 2_000_000, 1000):
        clock.saw(SensorUs(epoch_us + t_us), HostNs(7_000_000_123 + t_us * 1000))
    assert clock.to_host(SensorUs(epoch_us + 1_500_001)) == 7_000_000_123 + 1_500_001_000
    assert clock.to_sensor(HostNs(7_000_000_123 + 1_500_001_000)) == epoch_us + 1_500_001
