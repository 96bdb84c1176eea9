"""A long run of the daemon: a day in virtual time, an hour against a service that runs."""
