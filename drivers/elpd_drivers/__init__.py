"""elpd_drivers: hardware, files and simulated worlds behind the seams of `elpd.ports`."""
