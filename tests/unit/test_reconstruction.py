"""Pictures from events: the high-pass filter, and E2VID with weights that the user brings."""

import re
import sys
from pathlib import Path
from typing import Any

import naive_baselines as naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from naive_baselines import SIDE, little_stack, texture

from elpd.baselines import FocusStack, e2vid
from elpd.baselines.e2vid import E2vid, normalised, voxel_grid
from elpd.baselines.reconstruction import CUT_OFF_RAD_S, leak_steps, reconstruct
from elpd.errors import FormatError, UsageError
from elpd.records import Geometry

EVENTS = st.lists(
    st.tuples(st.integers(0, 400_000), st.integers(0, 4), st.integers(0, 3), st.integers(0, 1)), min_size=1, max_size=50
).map(sorted)


def columns(events: list[tuple[int, int, int, int]]) -> tuple[Any, Any, Any, Any]:
    table = np.array(events, dtype=np.int64).reshape(-1, 4)
    return (
        table[:, 0].copy(),
        table[:, 1].astype(np.uint16),
        table[:, 2].astype(np.uint16),
        table[:, 3].astype(np.uint8),
    )


# --- the high-pass filter ----------------------------------------------------------------------------------------


@given(EVENTS, st.floats(0.0, 50.0), st.floats(0.2, 3.0))
@settings(max_examples=60, deadline=None)
def test_leaky_integration_is_its_twin(events: list[Any], decay: float, off_step: float) -> None:
    level, last_us = np.zeros((4, 5)), np.zeros((4, 5))
    leak_steps(*columns(events), decay * 1e-6, off_step, level, last_us)
    until_us = 400_001
    level *= np.exp(-decay * 1e-6 * (until_us - last_us))
    np.testing.assert_allclose(
        level, naive.leak_steps(events, decay * 1e-6, off_step, (4, 5), until_us), rtol=1e-9, atol=1e-9
    )


def appearing(picture: np.ndarray) -> FocusStack:
    """A picture that comes into focus from far out of it: what changes is what is sharp in the end."""
    return little_stack(picture, focus_us=200_000.0, threshold=0.05, frame_every_us=None, widest_px=8.0)


def test_a_picture_that_appears_is_reconstructed() -> None:
    picture = texture(5)
    stack = appearing(picture)
    seen = reconstruct(stack.t_us, stack.x, stack.y, stack.on, stack.geometry, stack.end_us)
    # What a blur of eight pixels leaves of the scene made no events.
    y, x = np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None, :]
    log = np.log(picture)
    low = np.exp(-2.0 * (np.pi * 8.0) ** 2 * (x * x + y * y))
    changed = log - np.fft.irfft2(np.fft.rfft2(log) * low, s=(SIDE, SIDE))
    inside = slice(4, -4)
    assert np.corrcoef(seen[inside, inside].ravel(), changed[inside, inside].ravel())[0, 1] > 0.8


def test_unequal_thresholds_do_not_tilt_it_and_what_rests_fades() -> None:
    geometry = Geometry(8, 8)
    # Each pixel goes up and down again; OFF thresholds are half as high, so there are twice as many OFF events.
    rows = [
        (1_000 * k + 37 * p, p % 8, p // 8, on) for p in range(64) for k, on in enumerate([1, 1, 0, 0, 0, 0])
    ]  # fmt: skip
    events = columns(sorted(rows))
    level = reconstruct(*events, geometry, int(events[0][-1]))
    assert np.abs(level).max() < 0.1
    up = columns([(0, 3, 3, 1)])
    fresh = reconstruct(*up, geometry, 0)
    rested = reconstruct(*up, geometry, 1_000_000)
    np.testing.assert_allclose(rested, fresh * np.exp(-CUT_OFF_RAD_S), rtol=1e-5)
    with pytest.raises(ValueError, match="later than the picture"):
        reconstruct(*up, geometry, -1)


# --- E2VID -------------------------------------------------------------------------------------------------------


@given(EVENTS)
@settings(max_examples=60, deadline=None)
def test_the_voxel_grid_is_its_twin(events: list[Any]) -> None:
    grid = voxel_grid(*columns(events), Geometry(5, 4))
    assert grid.shape == (5, 4, 5)
    np.testing.assert_allclose(grid, naive.voxel_grid(events, (4, 5)), atol=1e-5)


def test_cells_that_saw_something_are_normalised_and_the_rest_stay_empty() -> None:
    grid = np.zeros((5, 4, 4), dtype=np.float32)
    grid[1, 2] = [1.0, 2.0, 3.0, 7.0]
    even = normalised(grid)
    assert even[1, 2].mean() == pytest.approx(0.0, abs=1e-6)
    assert even[1, 2].std(ddof=1) == pytest.approx(1.0, abs=1e-6)
    assert np.count_nonzero(even) == 4
    np.testing.assert_array_equal(normalised(np.zeros((5, 2, 2), dtype=np.float32)), 0.0)


def test_without_weights_or_torch_it_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match=re.escape("E2VID_lightweight.pth.tar")):
        E2vid(tmp_path / "none.pth.tar")
    (tmp_path / "some.pth.tar").write_bytes(b"not a checkpoint")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UsageError, match="pip install"):
        E2vid(tmp_path / "some.pth.tar")


@pytest.fixture
def torch() -> Any:
    return pytest.importorskip("torch", reason="torch is not installed: pip install 'elpd[e2vid]'")


def checkpoint(torch: Any, path: Path, *, transposed: bool, normalise: bool) -> Any:
    """Save random weights in a network of ``torch``'s own modules, under the published names; return the network."""
    nn = torch.nn
    torch.manual_seed(3)

    def named(**parts: Any) -> Any:
        return nn.ModuleDict({name: part for name, part in parts.items() if part is not None})

    def norm(channels: int) -> Any:
        if not normalise:
            return None
        layer = nn.BatchNorm2d(channels)
        torch.nn.init.normal_(layer.running_mean, std=0.1)
        torch.nn.init.uniform_(layer.running_var, 0.5, 2.0)
        torch.nn.init.normal_(layer.weight, 1.0, 0.2)
        torch.nn.init.normal_(layer.bias, std=0.2)
        return layer

    def conv(fed: int, made: int, size: int, stride: int = 1, *, normed: bool = True) -> Any:
        bias = not (normalise and normed)
        return named(
            conv2d=nn.Conv2d(fed, made, size, stride, size // 2, bias=bias), norm_layer=norm(made) if normed else None
        )

    def up(fed: int) -> Any:
        if not transposed:
            return conv(fed, fed // 2, 5)
        layer = nn.ConvTranspose2d(fed, fed // 2, 5, stride=2, padding=2, output_padding=1, bias=not normalise)
        return named(transposed_conv2d=layer, norm_layer=norm(fed // 2))

    def block(channels: int) -> Any:
        first, second = (nn.Conv2d(channels, channels, 3, padding=1, bias=not normalise) for _ in range(2))
        return named(conv1=first, bn1=norm(channels), conv2=second, bn2=norm(channels))

    def encoder(fed: int) -> Any:
        gates = named(Gates=nn.Conv2d(4 * fed, 8 * fed, 3, padding=1))
        return named(conv=conv(fed, 2 * fed, 5, 2), recurrent_block=gates)

    unet = named(
        head=conv(5, 4, 5, normed=False),
        encoders=nn.ModuleList([encoder(4), encoder(8)]),
        resblocks=nn.ModuleList([block(16), block(16)]),
        decoders=nn.ModuleList([up(16), up(8)]),
        pred=conv(4, 1, 1),
    )
    network = named(unetrecurrent=unet).eval()
    torch.save({"arch": "E2VIDRecurrent", "model": {"num_bins": 5}, "state_dict": network.state_dict()}, path)
    return network


def reference_picture(torch: Any, network: Any, grids: list[np.ndarray], *, transposed: bool) -> np.ndarray:
    """Run the same network through the modules, as the published figure shows it."""
    unet = network["unetrecurrent"]
    state: list[Any] = [None, None]

    def apply(part: Any, here: Any) -> Any:
        for name in ("conv2d", "transposed_conv2d", "norm_layer"):
            here = part[name](here) if name in part else here
        return here

    picture = None
    for grid in grids:
        with torch.no_grad():
            head = here = torch.relu(apply(unet["head"], torch.from_numpy(grid[None])))
            skips = []
            for k, one in enumerate(unet["encoders"]):
                here = torch.relu(apply(one["conv"], here))
                hidden, cell = state[k] or (torch.zeros_like(here), torch.zeros_like(here))
                gates = one["recurrent_block"]["Gates"](torch.cat((here, hidden), 1))
                let_in, keep, let_out, new = gates.split(here.shape[1], 1)
                cell = keep.sigmoid() * cell + let_in.sigmoid() * new.tanh()
                here = let_out.sigmoid() * cell.tanh()
                state[k] = (here, cell)
                skips.append(here)
            for one in unet["resblocks"]:
                inner = one["conv1"](here)
                inner = torch.relu(one["bn1"](inner) if "bn1" in one else inner)
                inner = one["conv2"](inner)
                here = torch.relu(here + (one["bn2"](inner) if "bn2" in one else inner))
            for one, skip in zip(unet["decoders"], reversed(skips), strict=True):
                here = here + skip
                if not transposed:
                    here = torch.nn.functional.interpolate(here, scale_factor=2, mode="bilinear")
                here = torch.relu(apply(one, here))
            picture = apply(unet["pred"], here + head).sigmoid()[0, 0].numpy()
    assert picture is not None
    return picture


@pytest.mark.parametrize("transposed", [True, False])
@pytest.mark.parametrize("normalise", [True, False])
def test_a_checkpoint_runs_as_its_modules_would(
    torch: Any, tmp_path: Path, *, transposed: bool, normalise: bool
) -> None:
    path = tmp_path / "weights.pth.tar"
    network = checkpoint(torch, path, transposed=transposed, normalise=normalise)
    rng = np.random.default_rng(8)
    grids = [rng.normal(size=(5, 16, 24)).astype(np.float32) for _ in range(3)]
    ours = E2vid(path)
    for grid in grids:
        seen = ours.see(grid)
    expected = reference_picture(torch, network, [normalised(grid) for grid in grids], transposed=transposed)
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    # The state counts, and can be forgotten.
    ours.forget()
    assert np.abs(ours.see(grids[-1]) - expected).max() > 1e-4


def test_any_size_is_padded_and_events_become_a_picture(torch: Any, tmp_path: Path) -> None:
    path = tmp_path / "weights.pth.tar"
    checkpoint(torch, path, transposed=True, normalise=True)
    rng = np.random.default_rng(9)
    events = columns(sorted((int(t), int(t) % 13, int(t) % 11, int(t) % 2) for t in rng.integers(0, 10_000, 400)))
    geometry = Geometry(13, 11)
    network = E2vid(path)
    first = e2vid.reconstruct(network, *events, geometry)
    assert first is not None
    assert first.shape == (11, 13)
    assert 0.0 <= first.min() < first.max() <= 1.0
    np.testing.assert_array_equal(e2vid.reconstruct(network, *events, geometry), first)
    assert e2vid.reconstruct(network, *(column[:0] for column in events), geometry) is None


def test_files_that_are_not_such_a_checkpoint_are_refused_by_name(torch: Any, tmp_path: Path) -> None:
    path = tmp_path / "weights.pth.tar"
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(FormatError, match="no checkpoint"):
        E2vid(path)
    torch.save([1, 2], path)
    with pytest.raises(FormatError, match="state_dict"):
        E2vid(path)
    tensors = checkpoint(torch, path, transposed=True, normalise=True).state_dict()
    gates = "unetrecurrent.encoders.1.recurrent_block.Gates.weight"
    for changed, told in (
        ({name: one for name, one in tensors.items() if name != gates}, f"lacks the tensor {gates}"),
        (tensors | {"unetrecurrent.extra.weight": tensors[gates]}, "another network: unetrecurrent.extra.weight"),
        (tensors | {gates: tensors[gates][:, :3]}, "do not fit together"),
        ({}, "lacks the tensor unetrecurrent.head.conv2d.weight"),
    ):
        torch.save({"state_dict": changed}, path)
        with pytest.raises(FormatError, match=re.escape(told)):
            E2vid(path)
