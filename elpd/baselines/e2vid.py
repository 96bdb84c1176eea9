"""E2VID: a picture from events by a recurrent network, with weights that the user brings.

(Rebecq et al., *High Speed and High Dynamic Range Video with an Event Camera*, TPAMI 2019.) The paper's ablation took
its reference from E2VID instead of from an opening aperture. The published checkpoint is not ours to ship, so this is
an adapter: give the file, have ``torch`` installed. The network is written here from the published architecture and
reads the checkpoint's tensors by name; how many encoders, residual blocks and channels there are, whether decoders
up-sample bilinearly or by transposed convolution, and whether layers are normalised, is read off the tensors
themselves. Each step takes a voxel grid of five bins and carries on the state of the last:

    head -> encoders (stride 2, each followed by a ConvLSTM) -> residual blocks -> decoders (x2) -> 1x1 -> sigmoid

with every decoder fed the sum of what came from below and of the encoder of its size. A file that holds tensors this
form has no place for, or lacks one, is refused by name. (Names and form are those of the authors' released program. The
published file itself could not be had here; what was tried are random weights under the same names.)

Nothing here is imported by the controller, and ``torch`` only when a file is opened.
"""

from __future__ import annotations

import math
import pickle
from typing import TYPE_CHECKING, Any

import numpy as np

from elpd.errors import FormatError, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from elpd.records import Geometry

BINS = 5
EVENTS_PER_PIXEL = 0.35
"""How many events make one voxel grid, per pixel: what the network was published with."""

_UNREADABLE = (pickle.UnpicklingError, RuntimeError, ValueError, KeyError, AttributeError, EOFError, OSError)
_ROOT = "unetrecurrent."
_NORM_EPSILON = 1e-5


class E2vid:
    """The network and its state; one ``see`` per voxel grid.

    Parameters
    ----------
    path:
        A checkpoint as published: ``torch.save`` of a dictionary with ``state_dict``.

    Raises
    ------
    UsageError
        If there is no such file, or ``torch`` is not installed.
    FormatError
        If the file is not such a checkpoint.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise UsageError(
                f"E2VID: no weights at {path}; get the published checkpoint (E2VID_lightweight.pth.tar, of the "
                "rpg_e2vid project) and give its path"
            )
        self._torch = _torch()
        self._tensors = self._load(path)
        self._used: set[str] = set()
        self._state: list[tuple[Any, Any]] | None = None
        self._encoders = self._count("encoders")
        self._check(path)

    def see(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take a voxel grid (5, height, width), of any size; return the picture (height, width), between 0 and 1."""
        height, width = grid.shape[1:]
        block = 2**self._encoders
        bottom, right = -height % block, -width % block
        rows, columns = (bottom // 2, bottom - bottom // 2), (right // 2, right - right // 2)
        padded = np.pad(normalised(grid), ((0, 0), rows, columns))
        with self._torch.no_grad():
            answer = self._forward(self._torch.from_numpy(np.ascontiguousarray(padded[None])))
        picture = answer[0, 0, bottom // 2 : bottom // 2 + height, right // 2 : right // 2 + width]
        return np.asarray(picture.numpy(), dtype=np.float32)

    def forget(self) -> None:
        """Begin anew: the next grid has no past."""
        self._state = None

    def _load(self, path: Path) -> dict[str, Any]:
        try:
            # Only tensors and plain values: a checkpoint from elsewhere must not run code here.
            kept = self._torch.load(path, map_location="cpu", weights_only=True)
        except _UNREADABLE as error:
            raise FormatError(f"E2VID: {path} is no checkpoint of tensors and plain values ({error})") from None
        tensors = kept.get("state_dict") if isinstance(kept, dict) else None
        if not isinstance(tensors, dict) or not all(isinstance(one, self._torch.Tensor) for one in tensors.values()):
            raise FormatError(f"E2VID: {path} has no state_dict of tensors; give the published checkpoint as it is")
        return {name: one.float() for name, one in tensors.items()}

    def _check(self, path: Path) -> None:
        """Run one small empty grid: whatever tensor is missing, left over or of a wrong shape shows now, not later."""
        side = 2**self._encoders
        try:
            answer = self._forward(self._torch.zeros(1, BINS, side, side))
        except KeyError as error:
            raise FormatError(f"E2VID: {path} lacks the tensor {error.args[0]}") from None
        except RuntimeError as error:
            raise FormatError(f"E2VID: tensors in {path} do not fit together ({error})") from None
        left = {name for name in self._tensors if not name.endswith("num_batches_tracked")} - self._used
        if left:
            raise FormatError(f"E2VID: {path} has tensors of another network: {', '.join(sorted(left)[:3])}, ...")
        if answer.shape != (1, 1, side, side):
            raise FormatError(f"E2VID: {path} makes {tuple(answer.shape)} of a grid {side} pixels wide, not a picture")
        self.forget()

    def _count(self, part: str) -> int:
        prefix = f"{_ROOT}{part}."
        return len({name[len(prefix) :].split(".")[0] for name in self._tensors if name.startswith(prefix)})

    def _forward(self, grid: Any) -> Any:
        torch = self._torch
        head = torch.relu(self._convolve(grid, f"{_ROOT}head.conv2d", padding=2))
        here, below, states = head, [], []
        for k in range(self._encoders):
            name = f"{_ROOT}encoders.{k}."
            here = torch.relu(self._layer(here, f"{name}conv.conv2d", f"{name}conv.norm_layer", stride=2, padding=2))
            state = None if self._state is None else self._state[k]
            here, cell = self._remember(here, state, f"{name}recurrent_block.Gates")
            states.append((here, cell))
            below.append(here)
        for k in range(self._count("resblocks")):
            name = f"{_ROOT}resblocks.{k}."
            inner = torch.relu(self._layer(here, f"{name}conv1", f"{name}bn1", padding=1))
            here = torch.relu(here + self._layer(inner, f"{name}conv2", f"{name}bn2", padding=1))
        for k in range(self._encoders):
            here = torch.relu(self._enlarge(here + below[-1 - k], f"{_ROOT}decoders.{k}."))
        self._state = states
        return torch.sigmoid(self._layer(here + head, f"{_ROOT}pred.conv2d", f"{_ROOT}pred.norm_layer"))

    def _remember(self, here: Any, state: tuple[Any, Any] | None, name: str) -> tuple[Any, Any]:
        """Return hidden and cell state of a convolutional LSTM (Shi et al. 2015)."""
        torch = self._torch
        hidden, cell = (torch.zeros_like(here), torch.zeros_like(here)) if state is None else state
        gates = self._convolve(torch.cat((here, hidden), dim=1), name, padding=1)
        let_in, keep, let_out, new = torch.chunk(gates, 4, dim=1)
        cell = torch.sigmoid(keep) * cell + torch.sigmoid(let_in) * torch.tanh(new)
        return torch.sigmoid(let_out) * torch.tanh(cell), cell

    def _enlarge(self, here: Any, name: str) -> Any:
        functional = self._torch.nn.functional
        if f"{name}transposed_conv2d.weight" in self._tensors:
            weight, bias = self._weight(f"{name}transposed_conv2d")
            wide = functional.conv_transpose2d(here, weight, bias, stride=2, padding=2, output_padding=1)
        else:
            wide = functional.interpolate(here, scale_factor=2.0, mode="bilinear", align_corners=False)
            wide = self._convolve(wide, f"{name}conv2d", padding=2)
        return self._normalise(wide, f"{name}norm_layer")

    def _layer(self, here: Any, name: str, norm: str, *, stride: int = 1, padding: int = 0) -> Any:
        return self._normalise(self._convolve(here, name, stride=stride, padding=padding), norm)

    def _convolve(self, here: Any, name: str, *, stride: int = 1, padding: int = 0) -> Any:
        weight, bias = self._weight(name)
        return self._torch.nn.functional.conv2d(here, weight, bias, stride=stride, padding=padding)

    def _normalise(self, here: Any, name: str) -> Any:
        """Normalise by the running statistics, where the checkpoint has some."""
        if f"{name}.running_mean" not in self._tensors:
            return here
        mean, variance = self._tensor(f"{name}.running_mean"), self._tensor(f"{name}.running_var")
        weight, bias = self._tensor(f"{name}.weight"), self._tensor(f"{name}.bias")
        scale = (weight / self._torch.sqrt(variance + _NORM_EPSILON))[None, :, None, None]
        return (here - mean[None, :, None, None]) * scale + bias[None, :, None, None]

    def _weight(self, name: str) -> tuple[Any, Any]:
        bias = self._tensor(f"{name}.bias") if f"{name}.bias" in self._tensors else None
        return self._tensor(f"{name}.weight"), bias

    def _tensor(self, name: str) -> Any:
        self._used.add(name)
        return self._tensors[name]


def reconstruct(
    network: E2vid,
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    geometry: Geometry,
) -> NDArray[np.float32] | None:
    """Return the picture (height, width) after all events, in order of time; ``None`` where there is none to see.

    The events are cut into equal parts of about ``EVENTS_PER_PIXEL`` for each pixel, one voxel grid each.
    """
    if t_us.size == 0:
        return None
    parts = max(1, round(t_us.size / (EVENTS_PER_PIXEL * geometry.height * geometry.width)))
    network.forget()
    picture = None
    for part in np.array_split(np.arange(t_us.size), parts):
        picture = network.see(voxel_grid(t_us[part], x[part], y[part], on[part], geometry))
    return picture


def voxel_grid(
    t_us: NDArray[np.int64],
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    on: NDArray[np.uint8],
    geometry: Geometry,
    bins: int = BINS,
) -> NDArray[np.float32]:
    """Return events (n,) as (bins, height, width): each polarity split between the two bins nearest in time.

    The first event lies at bin 0 and the last at bin ``bins - 1``; between, shares are linear (Zhu et al. 2018).
    """
    grid = np.zeros(bins * geometry.height * geometry.width)
    if t_us.size:
        span_us = max(int(t_us[-1] - t_us[0]), 1)
        place = (bins - 1) * (t_us - t_us[0]) / span_us
        lower = np.floor(place).astype(np.int64)
        polarity = 2.0 * (on > 0) - 1.0
        pixel = y.astype(np.int64) * geometry.width + x
        for at, share in ((lower, 1.0 - (place - lower)), (lower + 1, place - lower)):
            inside = at < bins
            index = at[inside] * (geometry.height * geometry.width) + pixel[inside]
            grid += np.bincount(index, weights=(polarity * share)[inside], minlength=grid.size)
    return grid.reshape(bins, geometry.height, geometry.width).astype(np.float32)


def normalised(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return *grid* with the mean taken off its non-zero cells and their spread made one."""
    cells = grid != 0.0
    count = int(np.count_nonzero(cells))
    if count < 2:
        return grid
    values = grid[cells].astype(np.float64)
    spread = math.sqrt(float(np.square(values - values.mean()).sum()) / (count - 1))
    result = grid.copy()
    result[cells] = (values - values.mean()) / (spread if spread > 0.0 else 1.0)
    return result


def _torch() -> Any:
    try:
        import torch  # noqa: PLC0415  (optional, and seconds to import)
    except ImportError:
        raise UsageError("E2VID: torch is not installed; pip install 'elpd[e2vid]' (or torch by itself)") from None
    return torch
