"""The PettingZoo environments under the name that PettingZoo's users expect: ``parallel_v1.parallel_env()``.

The version is that of the environment ids.
"""

from mo_deepdrive import env, parallel_env, raw_env

__all__ = ["env", "parallel_env", "raw_env"]
