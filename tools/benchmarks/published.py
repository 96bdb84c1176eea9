"""The paper's own numbers, to stand beside ours: errors (um) and times (ms), recomputed from its detail tables.

An estimate made in hindsight with tuned offsets is what the paper reports for ELP; it says nothing about when the
decision was made.
"""

from __future__ import annotations

MOTIONS = ("static", "moderate", "violent")

SYN_MAE_UM: dict[tuple[str, str], tuple[float, float, float]] = {
    ("egs", "-"): (33.31, 29.33, 21.78),
    ("pbf", "-"): (4.93, 3.99, 2.69),
    ("elp-syn-1fps", "1"): (2.00, 3.66, 3.66),
    ("elp-syn", "20"): (2.00, 2.40, 2.97),
    ("elp-syn", "50"): (2.00, 1.51, 2.26),
}
"""MAE by (method, frame rate), in the order of ``MOTIONS``."""

RERUN_MAE_UM: dict[tuple[str, str], tuple[float, float, float]] = {
    ("esva", "-"): (2.5, 4.4, 9.0),
    ("elp-syn", "50"): (6.6, 6.7, 7.5),
}
"""ESVA's authors' rerun (CVPR 2026), their milliseconds times 0.8 um; second-hand."""


RIG_MOTIONS = ("static", "dynamic")
RIG_MAE_UM: dict[tuple[str, str], tuple[float, float]] = {
    ("davis-bright", "egs"): (36.6, 27.6),
    ("davis-bright", "pbf"): (10.9, 5.8),
    ("davis-bright", "elp-davis"): (0.30, 0.40),
    ("davis-dark", "egs"): (25.1, 24.4),
    ("davis-dark", "pbf"): (5.3, 9.9),
    ("davis-dark", "elp-davis"): (0.29, 0.20),
    ("evk4-bright", "egs"): (41.0, 26.4),
    ("evk4-bright", "pbf"): (3.8, 8.1),
    ("evk4-bright", "elp-evk4"): (0.07, 0.49),
    ("evk4-dark", "egs"): (53.9, 43.2),
    ("evk4-dark", "pbf"): (24.1, 14.1),
    ("evk4-dark", "elp-evk4"): (1.04, 0.67),
}
"""MAE on the paper's own rig by (set that is like it, method), in the order of ``RIG_MOTIONS``."""

RIG_TIMES_MS: dict[tuple[str, str], tuple[float, float]] = {
    ("davis", "egs"): (10.81, 310.8),
    ("davis", "pbf"): (2.37, 302.4),
    ("davis", "elp-davis"): (12.14, 103.4),
    ("evk4", "egs"): (104.25, 404.3),
    ("evk4", "pbf"): (2.52, 302.5),
    ("evk4", "elp-evk4"): (83.0, 113.0),
}
"""Run time and focusing time there by (camera, method). ELP's leave out the aperture, braking and settling."""


def published_mae_um(set_name: str, method: str, rate: str, motion: str) -> float | None:
    """Return the paper's MAE for a method, frame rate and motion on the set that is like its own, if it has one."""
    if set_name == "syn":
        row = SYN_MAE_UM.get((method, rate))
        return None if row is None or motion not in MOTIONS else row[MOTIONS.index(motion)]
    measured = RIG_MAE_UM.get((set_name, method))
    return None if measured is None or motion not in RIG_MOTIONS else measured[RIG_MOTIONS.index(motion)]


def published_times_ms(set_name: str, method: str) -> tuple[float, float] | tuple[None, None]:
    """Return the paper's run time and focusing time on the camera that the set is like."""
    return RIG_TIMES_MS.get((set_name.split("-", maxsplit=1)[0], method), (None, None))


def rerun_mae_um(method: str, rate: str, motion: str) -> float | None:
    """Return the independent rerun's MAE, if it has one."""
    row = RERUN_MAE_UM.get((method, rate))
    return None if row is None or motion not in MOTIONS else row[MOTIONS.index(motion)]
