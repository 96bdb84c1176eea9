"""The paper's own numbers (um), to stand beside ours: its tables for the synthetic set, recomputed from its 84 rows.

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


def published_mae_um(method: str, rate: str, motion: str) -> float | None:
    """Return the paper's MAE for a method, frame rate and motion, if it has one."""
    row = SYN_MAE_UM.get((method, rate))
    return None if row is None or motion not in MOTIONS else row[MOTIONS.index(motion)]


def rerun_mae_um(method: str, rate: str, motion: str) -> float | None:
    """Return the independent rerun's MAE, if it has one."""
    row = RERUN_MAE_UM.get((method, rate))
    return None if row is None or motion not in MOTIONS else row[MOTIONS.index(motion)]
