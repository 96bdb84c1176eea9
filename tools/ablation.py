"""Does registered regression add something to our estimate? ``python tools/ablation.py RESULTS [RESULTS ...]``.

RESULTS are folders that ``tools/benchmark.py --methods elpd,registered`` has left. On the sweeps that both have an
answer to, the two are averaged as well as they can be: bias and weight are fitted to all sweeps but one, by least
squares, and tried on that one. What comes out is compared with ours alone, treated the same way (its bias taken off),
and with ours as it is. Where registered regression knew something that ours does not, the average would be better.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

OURS, REGISTERED = "elpd", "registered"


def main() -> int:
    """Read, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs="+")
    rows = [
        row
        for folder in parser.parse_args().results
        for path in sorted((folder / "rows").glob("*.json"))
        for row in json.loads(path.read_text(encoding="utf-8"))["rows"]
    ]
    print("set, frames              sweeps  ours alone  registered alone  both  mean error of registered, um")
    print("   error of ours, um, rms: as it is, freed of its bias, averaged with registered; weight of registered")
    for set_name in sorted({row["set_name"] for row in rows}):
        for rate in sorted({row["rate"] for row in rows if row["method"] == REGISTERED}):
            print(told(set_name, rate, rows))
    return 0


def told(set_name: str, rate: str, rows: list[dict[str, Any]]) -> str:
    """Return the lines of one set and frame rate."""
    found: dict[str, dict[Any, float | None]] = {OURS: {}, REGISTERED: {}}
    for row in rows:
        if row["set_name"] == set_name and row["rate"] == rate and row["method"] in found:
            found[row["method"]][row["case"], row["seed"]] = row["error_um"]
    ours, theirs = found[OURS], found[REGISTERED]
    cases = sorted(ours.keys() & theirs.keys())
    alone = sum(ours[one] is not None and theirs[one] is None for one in cases)
    added = sum(ours[one] is None and theirs[one] is not None for one in cases)
    both = [one for one in cases if ours[one] is not None and theirs[one] is not None]
    head = f"{set_name + ', ' + rate:24s} {len(cases):6d} {alone:11d} {added:17d} {len(both):5d}"
    if len(both) < 4:
        return head
    a, b = (np.array([one[case] for case in both], np.float64) for one in (ours, theirs))
    weights, averaged = left_out(a, b)
    freed = left_out_bias(a)
    return (
        f"{head}  {b.mean():+.1f} +- {b.std(ddof=1):.1f}\n"
        f"   {rms(a):.2f}, {rms(freed):.2f}, {rms(averaged):.2f}; {np.median(weights):+.2f}"
    )


def left_out(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return, for each sweep, the weight that the others give to *theirs*, and the average's error with it."""
    weights, errors = np.empty(ours.size), np.empty(ours.size)
    for k in range(ours.size):
        a, b = np.delete(ours, k), np.delete(theirs, k)
        difference = b - a - (b - a).mean()
        total = float(difference @ difference)
        weights[k] = 0.0 if total == 0.0 else -float(difference @ (a - a.mean())) / total
        bias = float(np.mean(a + weights[k] * (b - a)))
        errors[k] = ours[k] + weights[k] * (theirs[k] - ours[k]) - bias
    return weights, errors


def left_out_bias(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each error less the mean of the others."""
    return np.asarray(errors - (errors.sum() - errors) / (errors.size - 1))


def rms(errors: NDArray[np.float64]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


if __name__ == "__main__":
    sys.exit(main())
