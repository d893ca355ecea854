"""onnxruntime without its telemetry, which writes a device's identity below the home and sends events. It reads the
setting when it is imported, so this is the only module that imports it."""

import os

os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as onnxruntime_errors

__all__ = ["onnxruntime", "onnxruntime_errors"]
