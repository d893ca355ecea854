"""Robots of any kind and number of modules, without a robot file."""

from modsoft.runtime import robot as robot_file


def of_modules(kind: str, modules: int, largest: float = 2.0) -> robot_file.Robot:
    table = {
        "robot": {"name": "r", "kind": kind, "modules": modules},
        "loop": {"hz": 2.5},
        "limits": {"largest_actuation_step": largest},
    }
    if kind == "pneumatic":
        table["valve"] = {"model": "v", "full_scale_bar": 1.0, "signal": "0-10 V"}
        sides = [(m, s) for m in range(1, modules + 1) for s in "+-"]
        table["chambers"] = [{"module": m, "side": s, "channel": i} for i, (m, s) in enumerate(sides)]
    return robot_file.from_dict(table)
