"""Studies, which measure something other than learning psi; each is a file or package with settings and a `run`."""
