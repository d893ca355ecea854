"""Model files that are damaged, that describe themselves wrongly, or that answer what no model should."""

import numpy as np
import onnx
from onnx import helper, numpy_helper

from modsoft.runtime.control import model_file as model_files


def damaged(sound, generator):
    """Bytes that differ from `sound`, in some way in which a file may be spoilt on a disk or in a transfer."""
    while True:
        content = bytearray(sound)
        at = generator.randrange(len(content))
        match generator.randrange(5):
            case 0:  # one bit
                content[at] ^= 1 << generator.randrange(8)
            case 1:  # a lost sector
                content[at : at + 512] = bytes(len(content[at : at + 512]))
            case 2:  # cut short
                del content[at:]
            case 3:  # something behind
                content += bytes([generator.randrange(256)]) * generator.randrange(1, 600)
            case 4:  # a byte lost
                del content[at]
        if content != sound:  # zeros over zeros, for instance
            return bytes(content)


def onnx_description(model):
    return model_files.msgspec.json.decode(model.metadata_props[0].value)


def redescribed(model_file, path, change):
    """A copy of the model at `path` whose description went through change(table), soundly sealed."""
    model = onnx.load(model_file)
    change(table := onnx_description(model))
    return sealed_at(path, model, table)


def sealed_at(path, model, table):
    """Writes a model with this description, soundly sealed; returns `path`."""
    table["file_sha256"] = model_files.UNSEALED
    del model.metadata_props[:]
    helper.set_model_props(model, {model_files.METADATA_KEY: model_files.msgspec.json.encode(table).decode()})
    path.write_bytes(model_files.with_checksum(model.SerializeToString()))
    return path


def running_wild(model_file, path, value, beyond):
    """A copy of the model at `path` that passes every check before a run, and answers `value` on three modules as soon
    as some feature but the label lies beyond `beyond`; the pairs that are replayed are of two and six modules."""
    model = onnx.load(model_file)
    graph = model.graph
    for node in graph.node:
        for index, name in enumerate(node.output):
            if name == model_files.ACTUATION:
                node.output[index] = "tame"
    constants = {
        "beyond": np.float32(beyond),
        "wild": np.float32(value),
        "three": np.int64([3]),
        "one": np.int64([1]),
        "two": np.int64([2]),
        "zero": np.int64([0]),
        "last": np.int64([-1]),
    }
    graph.initializer.extend(numpy_helper.from_array(np.asarray(array), name) for name, array in constants.items())
    graph.node.extend(
        [
            helper.make_node("Shape", [model_files.FEATURES], ["shape"]),
            helper.make_node("Slice", ["shape", "one", "two"], ["modules"]),
            helper.make_node("Equal", ["modules", "three"], ["are_three"]),
            helper.make_node("Slice", [model_files.FEATURES, "zero", "last", "two"], ["unlabelled"]),
            helper.make_node("ReduceMax", ["unlabelled"], ["largest"], keepdims=0),
            helper.make_node("Greater", ["largest", "beyond"], ["is_beyond"]),
            helper.make_node("And", ["are_three", "is_beyond"], ["is_wild"]),
            helper.make_node("Where", ["is_wild", "wild", "tame"], [model_files.ACTUATION]),
        ]
    )
    return sealed_at(path, model, onnx_description(model))
