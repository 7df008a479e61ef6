"""The installed Chromium, driven by its own driver, and pages to open in it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from algorithms.reporting.page.data import ExplorableFront, explorable_best_known
from algorithms.reporting.page.page import write_page
from algorithms.runs.build import build, load_policy
from algorithms.runs.config import load_experiment
from algorithms.runs.report import evaluate_front, explorable
from algorithms.runs.run_directory import Run
from tests.browser.explorer_page import EPISODES, SEED, Page

ZOO = "one_waypoint_front-pcn"
CONDITIONED = "one_waypoint_drawn_front-conditioned_mo_ppo"
# A short training on drawn destinations, so that the episodes of a policy differ.
DRAWN = """
environment: {id: mo-deepdrive-one-waypoint-v0, arguments: {time_limit: 3}}
algorithm:
  name: pcn
  learning_rate: 1e-2
  hidden: [32, 32]
  batch_size: 128
  gradient_steps: 100
  warmup_episodes: 64
  persistence: 0.95
  buffer_size: 100
  horizon_reduction: 0
  horizon_scale: 20.0
training: {total_timesteps: 3000, num_envs: 16, seed: 3}
evaluation: {episodes: 1, final_episodes: 2}
"""
SWITCHES = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """The installed Chromium; nothing is downloaded."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    chrome = shutil.which("chromium") or shutil.which("google-chrome")
    chromedriver = shutil.which("chromedriver")
    if chrome is None or chromedriver is None:
        pytest.skip("Chromium or its driver is not installed (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = chrome
    for switch in SWITCHES:
        options.add_argument(switch)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(chromedriver))
    yield driver
    driver.quit()


@pytest.fixture
def page(browser: Any) -> Iterator[Page]:
    """Opens pages; at the end of the test the browser has reported no error."""
    opened = Page(browser)
    yield opened
    assert opened.errors() == []


@pytest.fixture(scope="session")
def zoo_front() -> ExplorableFront:
    """A front of the zoo: 91 policies, every episode of which is the same."""
    run = Run.open(ZOO)
    return explorable(run, load_policy(run), ZOO)


@pytest.fixture(scope="session")
def zoo_page(zoo_front: ExplorableFront, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a front of the zoo and of a best-known one."""
    path = tmp_path_factory.mktemp("zoo") / "explore.html"
    write_page([zoo_front, explorable_best_known("one_waypoint_discrete")], path, "Explorer")
    return path


@pytest.fixture(scope="session")
def drawn_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that learnt a front on drawn scenarios."""
    folder = tmp_path_factory.mktemp("drawn")
    (folder / "drawn.yaml").write_text(DRAWN)
    experiment = load_experiment(folder / "drawn.yaml")
    run = Run.create(experiment, folder / "run")
    run.unlock()
    agent = build(experiment)
    agent.train(experiment.training.total_timesteps)
    agent.save(run.checkpoint)
    front = evaluate_front(agent, experiment, episodes=2, seed=SEED)
    assert len(front) > 3
    front.write(run.path, {"step": agent.step})
    return run.path


@pytest.fixture(scope="session")
def drawn_front(drawn_run: Path) -> ExplorableFront:
    """The front of that run."""
    return front_on_drawn_scenarios(str(drawn_run), "drawn")


def front_on_drawn_scenarios(name: str, title: str) -> ExplorableFront:
    """The front of a run, or of the zoo, on a few episodes that differ."""
    run = Run.open(name)
    return replace(explorable(run, load_policy(run), name, episodes=EPISODES, seed=SEED), title=title)


@pytest.fixture(scope="session")
def conditioned_front() -> ExplorableFront:
    """A front of the zoo: policies of one network under preferences, on drawn destinations."""
    return front_on_drawn_scenarios(CONDITIONED, CONDITIONED)


@pytest.fixture(scope="session")
def conditioned_page(conditioned_front: ExplorableFront, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of that front."""
    path = tmp_path_factory.mktemp("conditioned_page") / "explore.html"
    write_page([conditioned_front], path, "Explorer")
    return path


@pytest.fixture(scope="session")
def drawn_page(drawn_front: ExplorableFront, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of that front."""
    path = tmp_path_factory.mktemp("drawn_page") / "explore.html"
    write_page([drawn_front], path, "Explorer")
    return path
