"""Simulated controllers: real wire protocols in front of the simulated lens."""
