"""Model files with damaged bytes, with an altered description, or with invalid outputs."""

import numpy as np
import onnx
from onnx import helper, numpy_helper

from modsoft.runtime.control import model_file as model_files


def corrupted(valid, generator):
    """`valid` with a random error of a disk or of a transfer."""
    while True:
        content = bytearray(valid)
        at = generator.randrange(len(content))
        match generator.randrange(5):
            case 0:  # one bit
                content[at] ^= 1 << generator.randrange(8)
            case 1:  # a sector of zeros
                content[at : at + 512] = bytes(len(content[at : at + 512]))
            case 2:  # truncated
                del content[at:]
            case 3:  # trailing bytes
                content += bytes([generator.randrange(256)]) * generator.randrange(1, 600)
            case 4:  # a missing byte
                del content[at]
        if content != valid:  # zeros may replace zeros
            return bytes(content)


def onnx_description(model):
    return model_files.msgspec.json.decode(model.metadata_props[0].value)


def with_description_changed(model_file, path, change):
    """Writes a copy of the model to `path`, its description altered by change(table), its checksum valid."""
    model = onnx.load(model_file)
    change(table := onnx_description(model))
    return write_model(path, model, table)


def write_model(path, model, table):
    """Writes a model with this description and a valid checksum; returns `path`."""
    table["file_sha256"] = model_files.CHECKSUM_PLACEHOLDER
    del model.metadata_props[:]
    helper.set_model_props(model, {model_files.METADATA_KEY: model_files.msgspec.json.encode(table).decode()})
    path.write_bytes(model_files.with_checksum(model.SerializeToString()))
    return path


def with_fault_below(model_file, path, value, threshold):
    """Writes a copy of the model to `path` that passes every check at start, and whose output for three modules is
    `value` while any feature except the label is below `threshold`. (The golden pairs have two and four modules.)"""
    model = onnx.load(model_file)
    graph = model.graph
    for node in graph.node:
        for index, name in enumerate(node.output):
            if name == model_files.ACTUATION:
                node.output[index] = "regular"
    constants = {
        "threshold": np.float32(threshold),
        "fault": np.float32(value),
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
            helper.make_node("ReduceMin", ["unlabelled"], ["least"], keepdims=0),
            helper.make_node("Less", ["least", "threshold"], ["is_below"]),
            helper.make_node("And", ["are_three", "is_below"], ["is_fault"]),
            helper.make_node("Where", ["is_fault", "fault", "regular"], [model_files.ACTUATION]),
        ]
    )
    return write_model(path, model, onnx_description(model))
