"""Error against run time wherever a default is decided, one family of measurements a file."""
