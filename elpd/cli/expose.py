"""`elpd expose`: stage 1 alone. Open the aperture, make the map, keep it for `elpd focus --reference last`."""

from __future__ import annotations

import time
from pathlib import Path

import click

from elpd.cli.common import config_options, json_option, print_json
from elpd.config import load
from elpd.errors import UsageError


@click.command("expose")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Write the map as a 16-bit PNG.")
@config_options
@json_option
def command(*, out: Path | None, config_path: Path | None, overrides: tuple[str, ...], as_json: bool) -> int:
    """Open the aperture and make the temporal map: exit 0 with a map of quality, 1 without."""
    config = load(config_path, overrides)
    from elpd import rig  # noqa: PLC0415  (numba and devices only now)
    from elpd.focus.expose import expose  # noqa: PLC0415
    from elpd.focus.stage import REST_LIMIT_MS, Stage  # noqa: PLC0415
    from elpd.focus.stored_map import StoredMap, save  # noqa: PLC0415
    from elpd.vision.pictures import write_log_png  # noqa: PLC0415

    if out is not None and not out.resolve().parent.is_dir():
        raise UsageError(f"--out {out}: there is no folder {out.resolve().parent}; make it first")
    parts = rig.build(config)
    try:
        parts.camera.start()
        stage = Stage(parts)
        position_um = stage.to_um(stage.rest(REST_LIMIT_MS).steps)
        image, (good, reason) = expose(stage, config.focus.transmittance)
        parts.camera.stop()
    finally:
        rig.release(parts)
    if image is not None and good:
        save(config.journal.directory / "last-map.npz", StoredMap(image, position_um, time.time()))
    if image is not None and out is not None:
        write_log_png(out, image.log_intensity)
    geometry = parts.camera.geometry
    fields = {
        "width": geometry.width,
        "height": geometry.height,
        "fired_fraction": None if image is None else image.fired_fraction,
        "open_us": None if image is None else int(image.open_us),
        "hot_pixels": None if image is None else image.hot_pixels,
        "filled_pixels": None if image is None else image.filled_pixels,
        "dynamic_range_db": None if image is None else image.dynamic_range_db,
        "out": None if image is None or out is None else str(out),
        "good": good,
        "reason": reason,
        "position_um": position_um,
    }
    if as_json:
        print_json(fields)
    elif image is None:
        print(f"no map: {reason}")
    else:
        print(
            f"{geometry.width}x{geometry.height}, {image.fired_fraction:.2%} of the pixels fired, "
            f"{image.dynamic_range_db:.0f} dB, {image.hot_pixels} hot, {image.filled_pixels} filled: {reason}"
        )
        if out is not None:
            print(f"written to {out}")
    return 0 if good else 1
