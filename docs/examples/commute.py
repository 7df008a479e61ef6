"""An own environment: a commuter chooses a gear at every kilometre, and is fast or saves energy."""

import gymnasium
import numpy as np
from gymnasium import spaces

KILOMETRES = 10
GEARS = ((4.0, 0.1), (2.0, 0.4), (1.0, 0.8))  # minutes and kWh per kilometre


class Commute(gymnasium.Env):
    """Ten kilometres; the reward is minus the time and minus the energy of each, which random hills quadruple."""

    objectives = ("time", "energy")

    def __init__(self):
        high = np.array([KILOMETRES, 1.0], dtype=np.float32)  # kilometre, whether it is a hill
        self.observation_space = spaces.Box(np.zeros_like(high), high)
        self.action_space = spaces.Discrete(len(GEARS))
        self.reward_space = spaces.Box(np.float32([-4.0, -3.2]), np.float32([0.0, 0.0]))
        self.reward_dim = len(self.objectives)

    def _observe(self):
        self.hill = bool(self.np_random.random() < 0.3)
        return np.array([self.kilometre, self.hill], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.kilometre = 0
        return self._observe(), {}

    def step(self, action):
        minutes, energy = GEARS[action]
        reward = -np.array([minutes, energy * (4 if self.hill else 1)], dtype=np.float32)
        self.kilometre += 1
        return self._observe(), reward, self.kilometre == KILOMETRES, False, {}


gymnasium.register("commute-v0", entry_point=Commute)
