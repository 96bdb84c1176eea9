"""`elpd calibrate`: the rig measures itself; one command per kind of profile, in ``elpd.cli.calibrate_<kind>``."""

from __future__ import annotations

from typing import ClassVar

import click

from elpd.cli import LazyGroup

KINDS = {
    "aperture": "transmittance against time of an opening aperture, and its delay",
    "sensor": "noise, hot pixels, thresholds, refractory period and photoreceptor lag of the camera",
}


class Kinds(LazyGroup):
    """The kinds of calibration, imported on demand."""

    table: ClassVar[dict[str, str]] = KINDS
    prefix: ClassVar[str] = "calibrate_"


@click.group("calibrate", cls=Kinds)
def command() -> None:
    """Measure the rig itself and keep what was found for later cycles."""
