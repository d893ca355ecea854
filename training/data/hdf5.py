"""Arrays in an HDF5 file that may come from a stranger: only what lies in the file, and no more than it holds."""

from __future__ import annotations

import h5py

from modsoft.runtime.errors import ModelError


def own_array(file: h5py.File, name: str) -> h5py.Dataset:
    """The array of floats `name` of an open file.

    `ModelError` where it is anything else: a link to another place or file, numbers that lie in other files (external
    or virtual storage), objects, or a shape larger than the file, which a compressed or empty one can claim.
    """
    link = file.get(name, getlink=True)
    where = f"{file.filename}: {name}"
    if link is None:
        raise ModelError(f"{where} is not in it; not a data set of modsoft-collect")
    if not isinstance(link, h5py.HardLink):
        raise ModelError(f"{where} is a link, expected the numbers themselves; copy the data set as a whole")
    found = file[name]
    if not isinstance(found, h5py.Dataset) or found.dtype.kind != "f":
        raise ModelError(f"{where} is no array of floats; not a data set of modsoft-collect")
    if found.is_virtual or found.external is not None:
        raise ModelError(f"{where} lies in other files, expected the numbers themselves; copy the data set as a whole")
    if found.nbytes > found.id.get_storage_size():
        raise ModelError(
            f"{where} claims {found.nbytes} bytes, the file holds {found.id.get_storage_size()} (compressed, or cut); "
            "write it without compression, or collect it again"
        )
    return found
