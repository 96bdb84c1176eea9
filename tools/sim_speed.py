"""How fast the simulated world is: simulated seconds per CPU second while the lens sweeps at 4 mm/s.

    python tools/sim_speed.py [--motion static|moderate|violent|shake] [--scene NAME] [--json]

Measured over a sweep of 200 ms through focus, reading every packet, the lens driver being polled: what a focus cycle
costs. The images of the ladder of blurs are made during it, as in a cycle. CPU time of the process, so a busy machine
does not matter much; the opening of the aperture (20 ms, twice as many steps and a logarithm per pixel) stands apart.
"""

from __future__ import annotations

import argparse
import json
import time

from elpd_drivers.sim.rig import build_rig

from elpd.records import BiasSet, Roi, StopMode
from elpd.units import HostNs

SWEEP_MS = 200
CASES = [
    ("davis346 346x260", {"camera": "davis346"}, None),
    ("evk4 1280x720", {"camera": "evk4"}, None),
    ("evk4, ROI 400x400", {"camera": "evk4"}, Roi(440, 160, 400, 400)),
]


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--motion", default="static")
    parser.add_argument("--scene", default="camera")
    parser.add_argument("--json", action="store_true")
    wanted = parser.parse_args()
    rows = [measure(name, camera, window, wanted.motion, wanted.scene) for name, camera, window in CASES]
    if wanted.json:
        print(json.dumps({"rows": rows}))
        return
    print(f"{'':20}{'sweep':>20}{'opening':>20}{'events':>12}")
    for row in rows:
        opening = f"{row['opening_s_per_cpu_s']:.3f} s/s" if row["opening_s_per_cpu_s"] else "-"
        print(f"{row['name']:20}{row['sweep_s_per_cpu_s']:16.2f} s/s{opening:>20}{row['mev_per_s']:7.1f} Mev/s")


def measure(name: str, camera: dict[str, str], window: Roi | None, motion: str, scene: str) -> dict[str, object]:
    """Time one case."""
    rig = build_rig({**camera, "motion": motion, "scene": scene, "start_um": -400.0})
    rig.camera.start()
    opening = None
    if rig.aperture is not None:
        rig.camera.apply_biases(BiasSet.EXPOSE)
        _pass(rig, 5)
        rig.aperture.open()
        opening = 30e-3 / _pass(rig, 30)[0]
        rig.camera.apply_biases(BiasSet.FOCUS)
    if window is not None:
        rig.camera.set_window(window)
    _pass(rig, 10)
    rig.lens.run(4000 / rig.um_per_step, HostNs(rig.clock.now_ns() + 10**9))
    cpu_s, sent_bytes = _pass(rig, SWEEP_MS)
    rig.lens.stop(StopMode.ABRUPT)
    # EVT3 takes about 2 words of 2 bytes for an event that stands alone, an array record 13 bytes.
    events = sent_bytes / (13 if camera["camera"] == "davis346" else 4.2)
    return {
        "name": name,
        "sweep_s_per_cpu_s": SWEEP_MS * 1e-3 / cpu_s,
        "opening_s_per_cpu_s": opening,
        "mev_per_s": events / SWEEP_MS * 1e-3,
    }


def _pass(rig, ms: float) -> tuple[float, int]:  # type: ignore[no-untyped-def]  # noqa: ANN001
    """Let virtual time pass; return CPU seconds and bytes sent."""
    end, sent_bytes = rig.clock.now_ns() + round(ms * 1e6), 0
    begun_s = time.process_time()
    while rig.clock.now_ns() < end:
        packet = rig.camera.read(0.001)
        rig.lens.poll()
        sent_bytes += 0 if packet is None else packet.data.nbytes
    return time.process_time() - begun_s, sent_bytes


if __name__ == "__main__":
    main()
