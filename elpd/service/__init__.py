"""The daemon: an engine that owns the rig, and a socket in front of it."""
