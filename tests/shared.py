"""Where the shared recordings are, and a mark for tests that need them."""

import os
from pathlib import Path

import pytest

SHARED = Path(os.environ.get("ELPD_SHARED", Path(__file__).resolve().parents[1] / "../shared"))
RECORDINGS = SHARED / "recordings"
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason=f"{SHARED} is not there; set ELPD_SHARED")
