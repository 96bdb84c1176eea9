"""A world to focus in: optics, scene, sensor, lens and boards, in virtual time."""
