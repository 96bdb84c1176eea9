"""elpd: closed-loop, real-time autofocus for event cameras.

Kept empty on purpose: ``from elpd.client import Client`` must not pull in numpy or numba.
"""

__version__ = "0.1.0"
