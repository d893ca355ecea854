"""A checkpoint file is valid, or refused in one line."""

import random

import pytest
import torch

from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints


def corrupted(sound, generator):
    content = bytearray(sound)
    at = generator.randrange(len(content))
    match generator.randrange(4):
        case 0:
            content[at] ^= 1 << generator.randrange(8)
        case 1:
            content[at : at + 64] = bytes(len(content[at : at + 64]))
        case 2:
            del content[at:]
        case 3:
            del content[at]
    return bytes(content)


def test_damaged_file_never_gives_other_values(tmp_path, make_checkpoint):
    """It is refused or, with damage only in the padding of the archive, equal."""
    path = make_checkpoint(tmp_path / "model.pt")
    sound, expected, generator, refused = path.read_bytes(), checkpoints.load(path), random.Random(0), 0
    for _ in range(300):
        path.write_bytes(corrupted(sound, generator))
        try:
            loaded = checkpoints.load(path)
        except ModelError:
            refused += 1
            continue
        weights, expected_weights = loaded.pop("weights"), dict(expected["weights"])
        assert loaded == {name: value for name, value in expected.items() if name != "weights"}
        assert weights.keys() == expected_weights.keys()
        assert all(torch.equal(weights[name], expected_weights[name]) for name in expected_weights)
    assert refused > 250


@pytest.mark.parametrize("content", [b"", b"j", b"jun", b"junk", b"PK\x03\x04", b"[robot]\n", bytes(600)])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "model.pt").write_bytes(content)
    with pytest.raises(ModelError, match=r"^[^\n]*not a checkpoint[^\n]*$"):
        checkpoints.load(tmp_path / "model.pt")
