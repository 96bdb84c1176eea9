"""Bytes to events: numba kernels with their state carried across any buffer split."""
