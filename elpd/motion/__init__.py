"""Where the lens is, and how to make it rest where it should."""
