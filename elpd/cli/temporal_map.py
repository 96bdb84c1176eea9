"""``elpd temporal-map``: an HDR picture from a recorded aperture opening."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, parse_interval_us, print_json
from elpd.cli.recordings import open_recording
from elpd.errors import FormatError, UsageError
from elpd.units import SensorUs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.pictures import write_display_png, write_log_png
from elpd.vision.temporal_map import quality, read_transmittance, temporal_image

if TYPE_CHECKING:
    from elpd.records import TemporalImage

PNG = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--aperture-us",
    "interval",
    metavar="A,B",
    help="The opening's begin and end on the sensor's clock; the whole recording, with the opening found, without.",
)
@click.option(
    "--transmittance",
    default="iris",
    show_default=True,
    metavar="linear|iris|FILE",
    help="How it opens: area grows evenly (linear), diameter grows evenly (iris), or a CSV of t_us,transmittance.",
)
@click.option("--out", type=PNG, help="Write the picture as 16-bit PNG, monotone in log intensity.")
@click.option("--display", type=PNG, help="Write an 8-bit PNG for eyes as well (1st to 99th percentile).")
@json_option
@config_options
def command(
    file: Path,
    interval: str | None,
    transmittance: str,
    out: Path | None,
    display: Path | None,
    *,
    as_json: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Make an HDR picture from the first ON event of each pixel while an aperture opened.

    The default profile is an iris: what lenses have, and what the method's authors assume. A wrong profile stretches
    the picture's contrast, but changes no order of brightness.
    """
    del config_path, overrides  # accepted by every command; nothing here is configurable
    aperture = parse_interval_us(interval, "--aperture-us")
    profile = read_transmittance(transmittance)
    gathered = _gather(file, aperture)
    image = temporal_image(gathered.believed(), profile, None if aperture is None else SensorUs(aperture[0]))
    usable, verdict = quality(image)
    if out is not None:
        write_log_png(out, image.log_intensity)
    if display is not None:
        write_display_png(display, image.log_intensity, image.valid)
    answer = {
        "width": gathered.geometry.width,
        "height": gathered.geometry.height,
        "fired_fraction": image.fired_fraction,
        "open_us": image.open_us,
        "hot_pixels": image.hot_pixels,
        "filled_pixels": image.filled_pixels,
        "dynamic_range_db": image.dynamic_range_db,
        "out": out,
        "usable": usable,
        "verdict": verdict,
    }
    if as_json:
        print_json(answer)
    else:
        _tell(image, out, "found" if aperture is None else "given", verdict if usable else f"BAD: {verdict}")


def _gather(file: Path, aperture: tuple[int, int] | None) -> FirstEventMap:
    """Read as much of the recording as the opening needs."""
    begin_us, end_us = aperture if aperture is not None else (None, None)
    reader = open_recording(file)
    try:
        if reader.geometry is None:
            raise FormatError(
                f"{file}: the file does not say how large the sensor is, which a map needs; "
                "convert it to a format whose header has a geometry"
            )
        gathered = FirstEventMap(reader.geometry, begin_us, end_us)
        for packet in reader.packets():
            gathered.add_packet(packet)
            if gathered.complete:
                break
    finally:
        reader.close()
    if gathered.first_us is None:
        raise FormatError(f"{file}: holds no event; record with the aperture opening, then try again")
    if gathered.n_on == 0 and aperture is not None:
        held = f"from {gathered.first_us} us" + ("" if gathered.complete else f" to {gathered.last_us} us")
        raise UsageError(
            f"no ON event between {begin_us} and {end_us} us; the recording has events {held}, "
            f"{gathered.n_before} of them ON before the interval; choose --aperture-us inside it"
        )
    return gathered


def _tell(image: TemporalImage, out: Path | None, opening: str, verdict: str) -> None:
    height, width = image.log_intensity.shape
    print(f"sensor         {width} x {height}")
    print(f"opening        {image.open_us} us ({opening})")
    print(f"fired          {100 * image.fired_fraction:.3f} % of the pixels")
    print(f"mended         {image.hot_pixels} hot, {image.filled_pixels} unfired")
    print(f"dynamic range  {image.dynamic_range_db:.1f} dB")
    print(f"quality        {verdict}")
    print(f"picture        {out if out is not None else 'not written (--out PNG)'}")
