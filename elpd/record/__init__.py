"""Runs on disk: written as they happen, replayed to the same decision, and foreign data sets read."""
