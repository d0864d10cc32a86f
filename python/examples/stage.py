"""A stage in Python: publishes a speed limit for each action, as examples/speed-gate does in Rust.

    python3 python/examples/stage.py [--run NAME]
"""

import argparse
import ctypes

import carff

FREE_M_S = 8.0


class SpeedLimit(ctypes.Structure):
    """Speed limit, metres per second, and the probability of all known states together."""

    _fields_ = [("header", carff.Header), ("limit_m_s", ctypes.c_float), ("known", ctypes.c_float)]

    @staticmethod
    def type_name() -> str:
        return "speed-gate.SpeedLimit.v1"


SPEED_LIMIT = carff.Topic("speed-gate/limit", SpeedLimit, False, carff.MESSAGES)


def main() -> None:
    parser = argparse.ArgumentParser(description="Publish a speed limit for each action.")
    parser.add_argument("--run", help="name of the run; optional if only one runs")
    args = parser.parse_args()
    with carff.join(args.run, "speed-gate") as node:
        beliefs, actions = node.receiver(carff.topic("prober/belief")), node.receiver(carff.topic("controller/action"))
        limits = node.publisher(SPEED_LIMIT)
        print(f"joined run `{node.run.name}`", flush=True)
        known = 0.0
        for action in actions:
            if (belief := beliefs.newest()) is not None:
                states = belief.message.state_probability[: int(belief.message.state_count)]
                known = min(float(states.sum()), 1.0)
            limit = SpeedLimit(action.header(), known=known)
            limit.limit_m_s = FREE_M_S * known if action.message.action == carff.ActionCode.ADVANCE else 0.0
            limits.send(limit)
        print(f"left run `{node.run.name}`", flush=True)


if __name__ == "__main__":
    main()
