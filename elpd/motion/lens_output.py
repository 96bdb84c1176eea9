"""An iris that is only open or closed, on an output of the lens's own controller.

It shares the lens's line and so cannot be a driver with a port of its own: whoever opens the lens hands it over. What
the mechanics do after the command nobody can see from here. ``opening_ms`` is a bound that its owner knows; how it
truly opens is measured by `elpd calibrate aperture`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import ConfigError
from elpd.ports import Outputs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from elpd.ports import Lens
    from elpd.records import CommandStamp

KEYS = ("output", "opening_ms", "inverted")


@dataclass(frozen=True, slots=True)
class LensOutputAperture:
    """``elpd.ports.Aperture`` on a switched output; *inverted* means that the output closes it."""

    lens: Outputs
    output: str
    opening_ms: float
    inverted: bool = False

    def open(self) -> CommandStamp:
        """Switch it open."""
        return self.lens.set_output(self.output, on=not self.inverted)

    def close(self) -> CommandStamp:
        """Switch it closed."""
        return self.lens.set_output(self.output, on=self.inverted)

    def transmittance(self, since_open_us: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what an iris of evenly growing diameter passes; its own curve takes a calibration."""
        grown = np.clip(np.asarray(since_open_us, dtype=np.float64) / (self.opening_ms * 1000), 0.0, 1.0)
        return np.square(grown)


def aperture_on_lens(settings: Mapping[str, Any], lens: Lens) -> LensOutputAperture:
    """Return the aperture that a table ``[aperture]`` with driver ``lens-output`` describes.

    Settings: ``output``, its name on the controller; ``opening_ms``, after which it is open for certain;
    ``inverted`` (default false). Raises ``ConfigError`` for a wrong table, or a controller without such an output.
    """
    for key in settings:
        if key not in KEYS:
            raise ConfigError(f"aperture.{key}: unknown key; known are {', '.join(KEYS)}")
    outputs = lens.outputs if isinstance(lens, Outputs) else ()
    if not outputs:
        raise ConfigError(
            'aperture.driver = "lens-output": this lens\'s controller has no output that it can be told to switch '
            '(a Tic drives its motor and nothing else); wire the iris to another controller, or use "manual"'
        )
    output, opening_ms, inverted = (settings.get(key) for key in KEYS)
    if output not in outputs:
        raise ConfigError(f"aperture.output is {output!r}; this lens's controller has {', '.join(outputs)}")
    if isinstance(opening_ms, bool) or not isinstance(opening_ms, (int, float)) or not opening_ms > 0:
        raise ConfigError(
            f"aperture.opening_ms is {opening_ms!r}; give the milliseconds after which the iris is open for certain "
            "(10 to 30 for a solenoid, 400 for a motor)"
        )
    if inverted not in {None, True, False}:
        raise ConfigError(f"aperture.inverted is {inverted!r}; it is true or false")
    assert isinstance(lens, Outputs)
    return LensOutputAperture(lens, str(output), float(opening_ms), bool(inverted))
