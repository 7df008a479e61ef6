"""The explorer of fronts in a browser: choices are those of the command choose, drives those of the simulator."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import gymnasium
import moocore
import numpy as np
import pytest
import yaml

from algorithms.commands import choose
from algorithms.commands.choose import expected_utility, rank_policies, weighted_sum
from algorithms.reporting.page.data import ExplorableFront
from algorithms.reporting.page.page import write_page
from algorithms.runs.build import load_policy
from algorithms.runs.run_directory import Run
from mo_deepdrive.evaluation.drives import Playback, Scene, record_scenes
from mo_deepdrive.evaluation.front import Front
from mo_deepdrive.evaluation.policy import AccruedReward
from mo_deepdrive.utilities import make_utility
from mo_deepdrive.world.scenarios import SCENARIOS
from tests.browser.conftest import CONDITIONED, ZOO
from tests.browser.explorer_page import NARROW, SEED, Page

pytestmark = [pytest.mark.slow, pytest.mark.browser]


def first_by(values: np.ndarray, front: ExplorableFront) -> int:
    """The policy that the rule of the command choose puts first."""
    return int(rank_policies(values, front.returns.mean(axis=1), front.scales)[0])


def undominated(front: ExplorableFront) -> list[int]:
    """The policies that no other one dominates in the returns and the time."""
    frequency = front.scenes[0].decision_frequency
    values = np.column_stack([front.returns.mean(axis=1), -front.lengths / frequency])
    return np.flatnonzero(moocore.is_nondominated(values, maximise=True, keep_weakly=True)).tolist()


def chosen_by_the_command(page: Page, capsys: pytest.CaptureFixture[str]) -> int:
    """Run the command that the page shows; the policy that it chooses."""
    words = page.command()
    assert words[:2] == ["mo-deepdrive", "choose"]
    capsys.readouterr()
    assert choose.main(words[2:]) == 0
    (number,) = re.findall(r"policy (\d+) of", capsys.readouterr().out.replace("\n", " "))
    return int(number)


# ----------------------------------------------------------------------------------------------------------- the choice


@pytest.mark.parametrize("which", ["zoo", "drawn", "conditioned"])
def test_sliders_choose_what_the_rule_of_choose_puts_first(
    page: Page, request: pytest.FixtureRequest, which: str
) -> None:
    front: ExplorableFront = request.getfixturevalue(f"{which}_front")
    page.open(request.getfixturevalue(f"{which}_page"))
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(12):
        page.slide("#weights", (rng.dirichlet(np.full(4, 0.6)) * 100).round().tolist())
        weights = page.preference("--weights")
        seen.add(first_by(weighted_sum(weights, front.objectives).values(front.returns), front))
        assert page.chosen() == first_by(weighted_sum(weights, front.objectives).values(front.returns), front)
    assert len(seen) > 1


def test_equal_values_are_ordered_as_choose_orders_them(page: Page, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    returns = rng.integers(-3, 1, (60, 20, 4)) * 0.1
    returns[40:] = returns[:20]  # the same policies again
    returns[:30] = returns[:30].round().mean(axis=1, keepdims=True)
    front = ExplorableFront(
        title="ties",
        objectives=("a", "b", "c", "d"),
        returns=returns,
        scales=np.array([10.0, 1.0, 5.0, 500.0]),
        signs=np.ones(4),
        success=np.full(60, np.nan),
        lengths=np.ones(60),
        command="mo-deepdrive choose RUN {preference}",
    )
    write_page([front], tmp_path / "explore.html", "Explorer")
    page.open(tmp_path / "explore.html")
    for importance in ([0, 0, 0, 0], [0, 100, 0, 0], [100, 0, 0, 0], [10, 1, 5, 0], [50, 50, 50, 50], [3, 90, 17, 66]):
        page.slide("#weights", importance)
        weights = page.preference("--weights")
        assert page.chosen() == first_by(weighted_sum(weights, front.objectives).values(returns), front)


@pytest.mark.parametrize("which", ["zoo", "drawn", "conditioned"])
def test_budgets_choose_the_greatest_expected_utility(page: Page, request: pytest.FixtureRequest, which: str) -> None:
    front: ExplorableFront = request.getfixturevalue(f"{which}_front")
    page.open(request.getfixturevalue(f"{which}_page"))
    page.mode("budget")
    rng = np.random.default_rng(1)
    for _ in range(8):
        page.slide("#budgets", [round(rng.uniform(0, 8), 1), round(rng.uniform(0, 80))])
        words = page.command()
        arguments = yaml.safe_load(words[words.index("--arguments") + 1])
        utility = make_utility(words[words.index("--utility") + 1], front.objectives, **arguments)
        assert page.chosen() == first_by(expected_utility(utility).values(front.returns), front)


def test_the_command_chooses_what_the_page_chose(
    page: Page, zoo_page: Path, drawn_page: Path, conditioned_page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in (zoo_page, drawn_page, conditioned_page):
        page.open(path)
        page.slide("#weights", [20, 0, 70, 30])
        assert chosen_by_the_command(page, capsys) == page.chosen()
        page.mode("budget")
        page.slide("#budgets", [3, 20])
        assert chosen_by_the_command(page, capsys) == page.chosen()


def test_a_link_keeps_the_choice(page: Page, drawn_page: Path) -> None:
    page.open(drawn_page)
    page.slide("#weights", [7, 0, 90, 40])
    page.set_range(2, 0, "-4.5")
    boxes = [box for box in page.all("#policies input[type=checkbox]") if box.is_enabled()]
    boxes[1].click()
    page.find("#scenario option[value='2']").click()
    link = page.link()

    def shown() -> list[Any]:
        sliders = [slider.get_property("value") for slider in page.all("#weights input")]
        labels = [page.text("#readings"), page.text("#kept"), page.command(), page.text("#parallel-legend")]
        scenario = page.find("#scenario").get_property("value")
        return [page.chosen(), sliders, labels, scenario, page.listed(), page.find("#map").get_attribute("viewBox")]

    before = shown()
    page.open(drawn_page)
    assert shown() != before
    page.open(drawn_page, link)
    assert shown() == before
    assert page.link() == link


@pytest.mark.parametrize(
    "link",
    [
        "#front=9",
        "#policy=-1&mode=picked",
        "#weights=1,2",
        "#weights=1,2,3,x",
        "#mode=budget&budget=a,b",
        "#range=9,1,2",
        "#compare=a,-1,1e9&scenario=7",
        "#returns=2&dominated=7",
        "#%",
    ],
)
def test_what_is_not_valid_in_a_link_is_left_at_its_default(page: Page, zoo_page: Path, link: str) -> None:
    page.open(zoo_page)
    before = page.chosen()
    page.open(zoo_page, link)
    assert page.text("#message") == ""
    if "mode=budget" not in link:
        assert page.chosen() == before


# ------------------------------------------------------------------------------------------------------------ the front


def test_brushing_keeps_the_policies_in_the_range(page: Page, zoo_page: Path, zoo_front: ExplorableFront) -> None:
    page.open(zoo_page)
    means = zoo_front.returns.mean(axis=1)
    front = undominated(zoo_front)
    assert sorted(page.listed()) == sorted({*front, page.chosen()})
    page.brush(3, 0.4, 0.7)
    jerk = np.concatenate([means[:, 3], zoo_front.best_known[:, 3]])
    low, high = (float(page.find(f"[data-range='3/{end}']").get_property("value")) for end in (0, 1))
    # Pixels are whole: of an axis of 324, two may be missing at each end.
    assert (low - jerk.min()) / np.ptp(jerk) == pytest.approx(0.4, abs=0.02)
    assert (high - jerk.min()) / np.ptp(jerk) == pytest.approx(0.7, abs=0.02)
    inside = [k for k in front if low <= means[k, 3] <= high]
    assert 0 < len(inside) < len(front)
    assert sorted(page.listed()) == sorted({*inside, page.chosen()})
    assert page.text("#kept").startswith(f"{len(inside)} of {len(front)} policies are in the ranges")
    page.brush(3, 0.5, 0.5)  # a click drops the range
    assert sorted(page.listed()) == sorted({*front, page.chosen()})


def test_dominated_policies_are_hidden_until_they_are_asked_for(
    page: Page, zoo_page: Path, zoo_front: ExplorableFront
) -> None:
    page.open(zoo_page)
    count, front = len(zoo_front.returns), undominated(zoo_front)
    assert 0 < len(front) < count

    def lines() -> int:
        return len(page.all("#parallel .line")) - len(zoo_front.best_known) - 1  # the chosen one twice

    assert lines() == len(front)
    chosen = page.chosen()
    assert chosen not in front
    assert re.search(r"Policy (\d+) is nowhere worse, and better in .*time\.", page.text("#why"))
    page.set_range(4, 1, str(zoo_front.lengths[chosen]))  # in which it is, too
    assert "outside" not in page.text("#kept")
    page.set_range(4, 1, "")
    assert page.text("#dominated-label") == f"show dominated policies ({count - len(front)} of {count})"
    page.find("#dominated").click()
    assert lines() == count
    assert sorted(page.listed()) == list(range(count))
    link = page.link()
    page.open(zoo_page, link)
    assert lines() == count
    assert f"best known ({len(zoo_front.best_known)} policies)" in page.text("#parallel-legend")


def test_the_time_is_the_last_axis_and_less_of_it_is_better(
    page: Page, zoo_page: Path, zoo_front: ExplorableFront
) -> None:
    page.open(zoo_page)
    seconds = zoo_front.lengths / zoo_front.scenes[0].decision_frequency
    assert page.text("#values").replace("\n", " ").endswith(f"time {seconds[page.chosen()]:.1f} s arrivals 100%")
    page.brush(4, 0.9, 1.0)
    low, high = (float(page.find(f"[data-range='4/{end}']").get_property("value")) for end in (0, 1))
    assert (low, high) == pytest.approx((seconds.min(), seconds.min() + 0.1 * np.ptp(seconds)), abs=0.5)
    known = page.run("return [...document.querySelectorAll('#front-select option')].length")
    page.open(zoo_page, f"#front={known - 1}")  # the best-known front, whose last objective is the time
    assert page.text("#weights").count("time") == page.text("#policies thead").count("time") == 1


def test_returns_are_undiscounted_unless_discounted_ones_are_asked_for(
    page: Page, zoo_page: Path, zoo_front: ExplorableFront, capsys: pytest.CaptureFixture[str]
) -> None:
    page.open(zoo_page)
    assert page.text("#sums") == "undiscounted sums over a drive"
    undiscounted = page.chosen()
    page.find("#returns option[value='1']").click()
    assert re.fullmatch(r"sums over a drive, discounted by . = 0\.99 per decision", page.text("#sums"))
    weights = weighted_sum(page.preference("--weights"), zoo_front.objectives)
    assert zoo_front.discounted is not None
    assert page.chosen() == first_by(weights.values(zoo_front.discounted.returns), zoo_front) != undiscounted
    assert f"best known ({len(zoo_front.discounted.best_known)} policies)" in page.text("#parallel-legend")
    assert chosen_by_the_command(page, capsys) == page.chosen()


def test_alternatives_are_differences_from_the_chosen_policy(
    page: Page, zoo_page: Path, zoo_front: ExplorableFront
) -> None:
    page.open(zoo_page)
    means = zoo_front.returns.mean(axis=1)
    rows = page.all("#trades tbody tr")
    assert len(rows) > 3
    for row in rows:
        reason, number, *cells = (cell.text for cell in row.find_elements("css selector", "th, td"))
        step = means[int(number)] - means[page.chosen()]
        for i, cell in enumerate(cells[:4]):
            shown = float(re.sub(r"[▲▼ +]", "", cell).replace("\N{MINUS SIGN}", "-"))
            assert shown == pytest.approx(step[i], abs=0.5 if i == 3 else 0.05)
            assert ("▲" in cell) == (shown > 0)
            name = zoo_front.objectives[i].replace("g_force", "g-force")
            if name in reason:
                assert step[i] > 0


# ----------------------------------------------------------------------------------------------------------- the drives


def driven(run: Run, k: int, seed: int) -> list[dict[str, float]]:
    """Telemetry of a policy of a run before the first and after every decision, driven alone."""
    policy = load_policy(run).policy(Front.read(run.path).conditions[k])
    environment = run.experiment.environment
    env: Any = gymnasium.make(environment.id, disable_env_checker=True, **environment.arguments).unwrapped
    observation, _ = env.reset(seed=seed)
    accrued, readings, over = AccruedReward.begin(1, 1, 4), [env.telemetry()[0]], False
    while not over:
        action = policy.act(observation[None, None], accrued, None)
        observation, reward, terminated, truncated, _ = env.step(policy.env.environment_actions(action)[0])
        accrued.add(np.asarray(reward, dtype=np.float32)[None, None], policy.gamma)
        readings.append(env.telemetry()[0])
        over = terminated or truncated
    return readings


@pytest.mark.parametrize("which", ["zoo", "drawn", "conditioned"])
def test_vehicles_are_where_the_simulator_had_them(page: Page, request: pytest.FixtureRequest, which: str) -> None:
    run = Run.open({"zoo": ZOO, "conditioned": CONDITIONED}.get(which) or request.getfixturevalue("drawn_run"))
    scenario = 0 if which == "zoo" else 1
    page.open(request.getfixturevalue(f"{which}_page"), f"#mode=picked&policy=2&compare=1&scenario={scenario}")
    drives = {k: driven(run, k, SEED + scenario) for k in (1, 2)}
    last = max(map(len, drives.values())) - 1
    assert page.find("#time").get_attribute("max") == str(last)
    for step in sorted({0, 1, last // 3, last // 2, last - 1, last}):
        page.scrub(step)
        poses = page.poses()
        assert set(poses) == {"1", "2"}
        for k, readings in drives.items():
            now = readings[min(step, len(readings) - 1)]
            x, y, degrees = poses[str(k)]
            assert (x, y) == pytest.approx((now["x"], now["y"]), abs=0.0051)
            assert math.radians(degrees) == pytest.approx(now["heading"], abs=0.0006)
        cells = page.text("#readings tbody tr:first-child").split()
        now = drives[2][min(step, len(drives[2]) - 1)]
        assert float(cells[2]) == pytest.approx(now["speed"], abs=0.011)
        assert float(cells[3]) == pytest.approx(now["g_force"], abs=0.0011)


def made_up_front(scenes: list[Scene], objectives: tuple[str, ...]) -> ExplorableFront:
    """Two policies with these drives."""
    d = len(objectives)
    return ExplorableFront(
        title="made up",
        objectives=objectives,
        returns=np.arange(2.0 * d).reshape(2, 1, d),
        scales=np.ones(d),
        signs=np.ones(d),
        success=np.zeros(2),
        lengths=np.ones(2),
        command="{preference}",
        scenes=tuple(scenes),
    )


class Spread:
    """Drives vehicle v of policy k as the number v + k says."""

    def __call__(self, observations: np.ndarray, accrued: np.ndarray, discounts: np.ndarray) -> np.ndarray:
        policies, vehicles, _ = observations.shape
        return 1 + (np.arange(vehicles) + np.arange(policies)[:, None]) % 8


def test_of_many_vehicles_each_is_shown_until_it_has_ended_with_its_own_returns(page: Page, tmp_path: Path) -> None:
    arguments = {"vehicles": 8, "time_limit": 8}
    scenes = record_scenes(Spread(), "mo-deepdrive-roundabout-v0", arguments, seeds=[4], drives=2)
    objectives = tuple(f"vehicle_{v}/{name}" for v in range(8) for name in ("distance", "jerk"))
    write_page([made_up_front(scenes, objectives)], tmp_path / "explore.html", "Explorer")
    page.open(tmp_path / "explore.html", "#mode=picked&policy=1&compare=0")
    readings = scenes[0].drives[1].readings
    lasts = np.isfinite(readings[:, :, 0]).sum(axis=0) - 1
    assert len(set(lasts)) > 1
    for step in sorted({0, *lasts}):
        page.scrub(int(step))
        shown = [each for each in page.all("#map .vehicle") if each.get_attribute("data-policy") == "1"]
        shown = [each for each in shown if each.is_displayed()]
        driving = np.flatnonzero(lasts >= step)
        assert [int(each.get_attribute("data-vehicle")) for each in reversed(shown)] == driving.tolist()
        moved = [re.findall(r"-?[\d.]+", each.get_attribute("transform"))[:2] for each in reversed(shown)]
        np.testing.assert_allclose(np.array(moved, dtype=float), readings[step, driving, :2], atol=0.0051)
    assert len(page.all("#map .lanes polyline")) == 36
    page.find("#vehicle option[value='5']").click()
    assert page.text("#values").splitlines()[::2] == ["vehicle 5: distance", "vehicle 5: jerk", "time", "arrivals"]
    assert page.text("#weights").count("vehicle 5") == page.text("#policies thead").count("vehicle 5") == 2
    assert page.text("#readings tbody tr:nth-child(6)").startswith("policy 1, vehicle 5")


def test_oncoming_cars_are_where_the_simulator_had_them(page: Page, tmp_path: Path) -> None:
    env_id = "mo-deepdrive-left-turn-v0"
    plans = [np.full(20, 14), np.full(60, 1)]
    scenes = record_scenes(Playback(plans, "discrete"), env_id, {"time_limit": 10}, seeds=[4], drives=2)
    front = made_up_front(scenes, SCENARIOS["left_turn"].objectives)
    write_page([front], tmp_path / "explore.html", "Explorer")
    page.open(tmp_path / "explore.html", "#mode=picked&policy=1&compare=0")
    cars = scenes[0].drives[1].cars
    seen = 0
    for step in range(0, len(cars), 9):
        page.scrub(step)
        shown = [car for car in page.all("#map .oncoming") if car.value_of_css_property("display") != "none"]
        present = cars[step][np.isfinite(cars[step][:, 0])]
        moved = [re.findall(r"-?[\d.]+", car.get_attribute("transform")) for car in shown]
        np.testing.assert_allclose(np.array(moved, dtype=float).reshape(-1, 3)[:, :2], present[:, :2], atol=0.0051)
        seen += len(shown)
    assert seen > 5


def test_the_animation_plays_pauses_and_goes_on(page: Page, zoo_page: Path) -> None:
    page.open(zoo_page)
    page.find("#speed option[value='5']").click()
    play = page.find("#play")
    play.click()
    assert play.text == "Pause"
    page.wait_for("return Number(document.getElementById('time').value) > 5")
    play.click()
    assert play.text == "Play"
    stopped = page.find("#time").get_property("value")
    page.run("return new Promise((resolve) => setTimeout(resolve, 150))")
    assert page.find("#time").get_property("value") == stopped
    last = int(page.find("#time").get_attribute("max"))
    page.scrub(last - 3)
    play.click()
    page.wait_for("return document.getElementById('play').textContent === 'Play'")
    assert page.find("#time").get_property("value") == str(last)
    play.click()  # from the start again
    page.wait_for("return Number(document.getElementById('time').value) < 60")
    play.click()


def test_without_drives_the_page_says_so(page: Page, zoo_front: ExplorableFront, tmp_path: Path) -> None:
    write_page([dataclasses.replace(zoo_front, scenes=())], tmp_path / "explore.html", "Explorer")
    page.open(tmp_path / "explore.html")
    assert page.text("#no-drive").startswith("There are no drives")
    assert not page.find("#map").is_displayed()


# ------------------------------------------------------------------------------------------------------------- messages


def few(front: ExplorableFront, count: int) -> ExplorableFront:
    """The first policies of a front."""
    scenes = tuple(dataclasses.replace(scene, drives=scene.drives[:count]) for scene in front.scenes)
    arrays = {name: getattr(front, name)[:count] for name in ("returns", "success", "lengths")}
    return dataclasses.replace(front, scenes=scenes, discounted=None, **arrays)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ('{"format":1,"fronts":[]}', "The data of this page have format 1; its code reads format 3."),
        ("[]", "The data of this page have format undefined"),
        ("null", "The data of this page have format undefined"),
        ('{"format":3,"fronts":[]}', "This page has no front."),
        ('{"format":3,"fronts":[', "The data of this page are broken."),
    ],
)
def test_data_that_cannot_be_read_are_a_message(
    page: Page, zoo_page: Path, tmp_path: Path, data: str, message: str
) -> None:
    whole = zoo_page.read_text(encoding="utf-8")
    pattern = r'(<script type="application/json" id="data">).*?(</script>)'
    broken = re.sub(pattern, lambda found: found[1] + data + found[2], whole, flags=re.DOTALL)
    (tmp_path / "explore.html").write_text(broken, encoding="utf-8")
    page.open(tmp_path / "explore.html")
    assert page.text("#message").startswith(message)
    assert not page.find("#content").is_displayed()


def test_text_in_the_data_is_shown_and_not_run(page: Page, zoo_front: ExplorableFront, tmp_path: Path) -> None:
    text = "</script><script>window.ran = true</script><img src=x onerror='window.ran = true'>"
    front = dataclasses.replace(
        few(zoo_front, 3),
        title=text,
        objectives=(text, *zoo_front.objectives[1:]),
        note=text,
        command=text,
        budget=None,
    )
    write_page([front, front], tmp_path / "explore.html", text)
    page.open(tmp_path / "explore.html")
    assert page.run("return window.ran") is None
    assert page.browser.title == text
    assert text in page.text("#note")
    assert text in page.text("#values")


def test_the_page_asks_for_nothing_on_the_network(page: Page, zoo_page: Path) -> None:
    page.open(zoo_page)
    assert page.run("return performance.getEntriesByType('resource').map((entry) => entry.name)") == []


# ------------------------------------------------------------------------------------------------ for everyone to use


def test_everything_can_be_done_with_the_keyboard(page: Page, zoo_page: Path, zoo_front: ExplorableFront) -> None:
    from selenium.webdriver import Keys

    page.open(zoo_page)

    def focus_on(condition: str) -> None:
        """Press Tab until ``condition`` is true of the element with the focus."""
        for _ in range(60):
            if page.run(f"const at = document.activeElement; return {condition}"):
                return
            page.press(Keys.TAB)
        pytest.fail(f"no element with {condition} is reached")

    focus_on("at.closest('#weights') !== null")
    before = page.preference("--weights")["distance"]
    page.press(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert page.preference("--weights")["distance"] == pytest.approx(before + 0.002)
    focus_on("at.tagName === 'SUMMARY'")
    page.press(Keys.ENTER)
    focus_on("at.dataset.range === '0/0'")
    page.press("14.4", Keys.TAB)
    assert page.text("#kept")
    focus_on("at.id === 'play'")
    page.press(Keys.SPACE)
    page.wait_for("return Number(document.getElementById('time').value) > 0")
    page.press(Keys.SPACE)
    assert page.text("#play") == "Play"
    focus_on("at.id === 'time'")
    now = int(page.find("#time").get_property("value"))
    page.press(Keys.ARROW_RIGHT)
    assert page.find("#time").get_property("value") == str(now + 1)
    focus_on("at.closest('#trades') !== null && at.type === 'checkbox'")
    page.press(Keys.SPACE)
    assert len(page.poses()) == 2
    focused = "const at = document.activeElement; return [at.tagName, at.type, at.closest('table').id]"
    assert page.run(focused) == ["INPUT", "checkbox", "trades"]
    focus_on("at.closest('#policies tbody') !== null && at.tagName === 'BUTTON'")
    page.press(Keys.ENTER)
    assert "mode=picked" in page.link()
    assert page.run(focused) == ["BUTTON", "button", "policies"]


@pytest.mark.parametrize("link", ["", "#front=1&mode=budget&compare=3,4,5"])
def test_a_phone_shows_the_page_without_scrolling_sideways(page: Page, zoo_page: Path, link: str) -> None:
    page.size(*NARROW)
    page.open(zoo_page, link)
    assert (
        page.run("const { scrollWidth, clientWidth } = document.documentElement; return scrollWidth - clientWidth") == 0
    )
    for name in ("#parallel svg", "#map", "#charts svg"):
        rectangle = page.find(name).rect
        assert rectangle["x"] >= 0
        assert rectangle["x"] + rectangle["width"] <= NARROW[0]
