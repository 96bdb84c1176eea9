"""``elpd temporal-map``: an HDR picture from a recorded aperture opening."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from elpd.cli.common import config_options, json_option, parse_interval_us, parse_size, print_json
from elpd.config import load
from elpd.errors import FormatError, UsageError
from elpd.events.stream import EventStream, open_recording
from elpd.units import SensorUs
from elpd.vision.first_events import FirstEventMap
from elpd.vision.pictures import write_display_png, write_log_png
from elpd.vision.temporal_map import quality, read_transmittance, temporal_image

if TYPE_CHECKING:
    from elpd.records import Geometry, TemporalImage

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
    help="How it opens: area grows evenly (linear), diameter does (iris), CSV of t_us,transmittance, or aperture.json.",
)
@click.option("--size", metavar="W,H", help="The sensor's size in pixels, for files that do not say it.")
@click.option("--out", type=PNG, help="Write the picture as 16-bit PNG, monotone in log intensity.")
@click.option("--display", type=PNG, help="Write an 8-bit PNG for eyes as well (1st to 99th percentile).")
@json_option
@config_options
def command(
    file: Path,
    interval: str | None,
    transmittance: str,
    size: str | None,
    out: Path | None,
    display: Path | None,
    *,
    as_json: bool,
    config_path: Path | None,
    overrides: tuple[str, ...],
) -> int:
    """Make an HDR picture from the first ON event of each pixel while an aperture opened.

    The default profile is an iris: what lenses have, and what the method's authors assume. A wrong profile stretches
    the picture's contrast, but changes no order of brightness.
    """
    load(config_path, overrides)  # every command takes them; a wrong key is wrong here too
    aperture = parse_interval_us(interval, "--aperture-us")
    profile = read_transmittance(transmittance)
    gathered = _gather(file, aperture, parse_size(size))
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
    return 0 if usable else 1


def _gather(file: Path, aperture: tuple[int, int] | None, size: Geometry | None) -> FirstEventMap:
    """Read as much of the recording as the opening needs; all of it if nothing is found, to say what it holds."""
    begin_us, end_us = aperture if aperture is not None else (None, None)
    reader = open_recording(file)
    try:
        geometry = size or reader.geometry
        if geometry is None:
            raise FormatError(
                f"{file}: the file does not say how large the sensor is, which a map needs; give --size W,H"
            )
        gathered = FirstEventMap(geometry, begin_us, end_us)
        for chunk in EventStream(reader, geometry).chunks():
            gathered.add(chunk.t, chunk.x, chunk.y, chunk.p)
            if gathered.complete and gathered.n_on:
                break
    finally:
        reader.close()
    if gathered.first_us is None:
        raise FormatError(f"{file}: holds no event inside the sensor; record while the aperture opens")
    if gathered.n_on == 0 and aperture is not None:
        raise UsageError(
            f"no ON event between {begin_us} and {end_us} us: the recording's events are from {gathered.first_us} to "
            f"{gathered.last_us} us, {gathered.n_before} of them ON before the interval; choose --aperture-us A,B there"
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
