"""How often the valve outputs of an emulated board went up."""


def rises(trace, since=0):
    """How often an output of any channel went up in `trace[since:]`, against its duty before."""
    duties = {}
    count = 0
    for index, event in enumerate(trace):
        if event["event"] == "pwm":
            count += index >= since and event["duty"] > duties.get(event["channel"], 0.0)
            duties[event["channel"]] = event["duty"]
    return count
