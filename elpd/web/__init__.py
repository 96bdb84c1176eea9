"""The page: a process of its own, without access to any device.

Browsers speak HTTP to it on the loopback; it speaks to the daemon over the daemon's unix socket, as any other client
does. No part of the rig is imported here: whatever this process does, the worst that it can ask for is what the daemon
allows its user. It has no state worth keeping but one token.

``door`` says how many may connect, ``security`` who may ask, ``relay`` shares one subscription among all tabs,
``commands`` carries requests to the daemon, ``pages`` serves the files, ``gateway`` puts them together.
"""
