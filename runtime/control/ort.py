"""onnxruntime with its telemetry disabled, which would write a device identity below the home and send events. The
setting takes effect at import, so no other module imports onnxruntime."""

import os

os.environ["ORT_DISABLE_TELEMETRY"] = "1"

import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as onnxruntime_errors

__all__ = ["onnxruntime", "onnxruntime_errors"]
