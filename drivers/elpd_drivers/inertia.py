"""iniVation's units of inertia and ours: accelerations in standard gravity, rotations in degrees a second."""

from __future__ import annotations

from math import degrees, radians

Axes = tuple[float, float, float]
STANDARD_GRAVITY_M_S2 = 9.80665


def acceleration_m_s2(in_g: Axes) -> Axes:
    """Convert from standard gravity to m/s^2."""
    x, y, z = in_g
    return x * STANDARD_GRAVITY_M_S2, y * STANDARD_GRAVITY_M_S2, z * STANDARD_GRAVITY_M_S2


def acceleration_g(in_m_s2: Axes) -> Axes:
    """Convert from m/s^2 to standard gravity."""
    x, y, z = in_m_s2
    return x / STANDARD_GRAVITY_M_S2, y / STANDARD_GRAVITY_M_S2, z / STANDARD_GRAVITY_M_S2


def rotation_rad_s(in_deg_s: Axes) -> Axes:
    """Convert from degrees a second to rad/s."""
    x, y, z = in_deg_s
    return radians(x), radians(y), radians(z)


def rotation_deg_s(in_rad_s: Axes) -> Axes:
    """Convert from rad/s to degrees a second."""
    x, y, z = in_rad_s
    return degrees(x), degrees(y), degrees(z)
