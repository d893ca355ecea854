"""Counts increases of the valve outputs of an emulated board."""


def rises(trace, since=0):
    """Number of events in `trace[since:]` that raise the duty of a channel above its previous one."""
    duties = {}
    count = 0
    for index, event in enumerate(trace):
        if event["event"] == "pwm":
            count += index >= since and event["duty"] > duties.get(event["channel"], 0.0)
            duties[event["channel"]] = event["duty"]
    return count
