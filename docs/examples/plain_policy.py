"""A driver written by hand, scored on the test split; the policy is a plain function of NumPy arrays."""

import numpy as np

from mo_deepdrive.evaluation import evaluate

NEXT_ANGLE, SPEED = 0, 11  # columns of the observation: see mo_deepdrive.world.observation.LAYOUT
CRUISE = 5.0  # m/s


def drive(observations, _accrued, _discounts):
    """Turn to the destination and hold the speed.

    Args:
        observations: (N, 15).
        _accrued: (N, 5) accrued reward: distance, destination, g-force, jerk and time.
        _discounts: (N,) gamma^t.

    Returns:
        (N, 3) steer, acceleration and brake in [-1, 1].
    """
    steer = np.clip(-0.2 * observations[:, NEXT_ANGLE], -1.0, 1.0)
    accelerate = np.clip(CRUISE - observations[:, SPEED], -0.3, 0.3)
    return np.stack([steer, accelerate, np.full(len(observations), -1.0)], axis=1)


def main(episodes=1000):
    """Evaluate, and print the metrics with their 95% intervals."""
    evaluation = evaluate(
        drive,
        "mo-deepdrive-one-waypoint-v1",
        split="test",
        episodes=episodes,
        utility="one_waypoint_linear",
        env_kwargs={"action_type": "continuous"},
    )
    for name, estimate in evaluation.estimates().items():
        print(f"{name:24} {estimate.text()}")
    return evaluation


if __name__ == "__main__":
    main()
