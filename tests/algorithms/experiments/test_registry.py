"""Names of algorithms and trained policies: looked up without importing what is not asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from algorithms import ALGORITHMS, zoo
from algorithms.experiments.registry import agent_class, algorithm_names, find_algorithm, find_trained_policy
from algorithms.peers import PEERS

if TYPE_CHECKING:
    from collections.abc import Callable


def test_names_are_known_without_importing_an_algorithm(run_python: Callable[[str], str]) -> None:
    loaded = run_python(
        "import sys\n"
        "from algorithms.experiments.registry import algorithm_names\n"
        "print(algorithm_names())\n"
        "print([name for name in sys.modules if name.startswith('algorithms.') and 'experiments' not in name], "
        "'torch' in sys.modules)"
    )
    assert loaded.splitlines() == [str(sorted(ALGORITHMS)), "[] False"]


@pytest.mark.slow
def test_peers_are_not_imported_for_an_algorithm_of_this_project(run_python: Callable[[str], str]) -> None:
    loaded = run_python(
        "import sys\n"
        "from algorithms.experiments.registry import find_algorithm\n"
        "find_algorithm('pcn')\n"
        "print([name for name in ('algorithms.pcn', 'algorithms.a2c', 'algorithms.peers') if name in sys.modules])"
    )
    assert loaded == "['algorithms.pcn']\n"


def test_every_algorithm_has_an_entry_and_a_class() -> None:
    assert algorithm_names() == sorted(ALGORITHMS)
    for name, algorithm in ALGORITHMS.items():
        entry = find_algorithm(name)
        assert (entry.name, entry.known_utility, entry.is_peer) == (name, algorithm.known_utility, False)
        assert entry.config_class is algorithm.Config
        assert agent_class(name) is algorithm


def test_peers_have_an_entry_but_no_class() -> None:
    for name, peer in PEERS.items():
        entry = find_algorithm(name)
        assert (entry.known_utility, entry.config_class, entry.is_peer) == (peer.known_utility, peer.Config, True)
        with pytest.raises(ValueError, match=f"algorithm '{name}' is another library's"):
            agent_class(name)


@pytest.mark.parametrize("name", ["mo_a2d", "", None, 3, ["pcn"]])
def test_unknown_algorithms_are_refused(name: object) -> None:
    with pytest.raises(ValueError, match=r"algorithm.name = .* is unknown; .*known: a2c, mo_a2c"):
        find_algorithm(name)


def test_trained_policies_are_found_in_the_zoo() -> None:
    for name in zoo.names():
        assert find_trained_policy(name) == zoo.find(name)
    with pytest.raises(ValueError, match="zoo"):
        find_trained_policy("no-such-policy")
