import random

import pytest

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
