"""Lens controllers over a serial line."""
