"""Arrays in an untrusted HDF5 file: only numbers that the file itself contains."""

from __future__ import annotations

import h5py

from modsoft.runtime.errors import ModelError


def own_array(file: h5py.File, name: str) -> h5py.Dataset:
    """The array of floats `name` of an open file.

    `ModelError` for anything else: a link to another place or file, numbers in other files (external or virtual
    storage), objects, or a shape larger than the stored bytes, which a compressed or empty array can claim.
    """
    link = file.get(name, getlink=True)
    where = f"{file.filename}: {name}"
    if link is None:
        raise ModelError(f"{where} is missing; not a data set of modsoft-collect")
    if not isinstance(link, h5py.HardLink):
        raise ModelError(f"{where} is a link, expected the numbers themselves; copy the data set as a whole")
    array = file[name]
    if not isinstance(array, h5py.Dataset) or array.dtype.kind != "f":
        raise ModelError(f"{where} is no array of floats; not a data set of modsoft-collect")
    if array.is_virtual or array.external is not None:
        raise ModelError(
            f"{where} is stored in other files, expected the numbers themselves; copy the data set as a whole"
        )
    if array.nbytes > array.id.get_storage_size():
        raise ModelError(
            f"{where} claims {array.nbytes} bytes, the file holds {array.id.get_storage_size()} (compressed, or cut); "
            "write it without compression, or collect it again"
        )
    return array
