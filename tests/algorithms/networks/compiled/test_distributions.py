"""What the compiled distributions consist of; ``test_actors.py`` compares the policies with torch's."""

from __future__ import annotations

import numpy as np
from algorithms.networks.compiled.distributions import exponential


def test_the_exponential_is_accurate_where_it_is_used() -> None:
    points = np.concatenate([np.linspace(-700.0, 700.0, 20_001), np.linspace(-1.0, 1.0, 2001)])
    np.testing.assert_allclose([exponential(x) for x in points], np.exp(points), rtol=1e-8)
