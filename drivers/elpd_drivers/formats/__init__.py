"""Event files, in and out."""
