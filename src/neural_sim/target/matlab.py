"""Numeric arrays of MATLAB files, of version 5 or of version 7.3, which is HDF5."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError

from neural_sim.extras import require


def read_arrays(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """The arrays of these names, with MATLAB's shapes; others in the file are not read.

    MATLAB stores arrays column by column, which HDF5 reads as the transpose. It drops trailing dimensions of size 1:
    the poses of one object are 3 x 4, those of two 3 x 4 x 2.

    Raises:
        ValueError: a file that is missing or no MATLAB file, or lacks a name.
    """
    require("bop", str(path))
    import h5py

    try:
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                found = {
                    name: np.asarray(file[name]).T
                    for name in names
                    if isinstance(file.get(name), h5py.Dataset)
                }
        else:
            found = scipy.io.loadmat(path, variable_names=list(names))
    except (OSError, ValueError, TypeError, NotImplementedError, MatReadError) as error:
        raise ValueError(f"{path}: not a readable MATLAB file ({error})") from error
    lacking = [name for name in names if name not in found]
    if lacking:
        raise ValueError(f"{path}: lacks {lacking}")
    return {name: np.asarray(found[name]) for name in names}
