// A page with data of fronts in it is the explorer of these alone; the page of all tabs loads its files when they are needed.

const TABS = ["drive", "preference", "against", "questions", "explorer"];

function explore(text) {
  hide({ content: false });
  try {
    new Explorer(readData(text));
  } catch (error) {
    hide({ content: true });
    showError(error);
  }
}

class Tabs {
  async start() {
    const page = await load("page.json");
    if (page.format !== WORLD_FORMAT || page.version !== VERSION) {
      throw new Refusal(`The files beside this page are of version ${page.version}, the page is of ${VERSION}. ${AGAIN}`);
    }
    this.page = page;
    this.stage = new Stage(page);
    this.questions = new Questions(page, (row, facts, weights) => {
      this.stage.taken.preference = row.name;
      const most = Math.max(...weights);
      this.stage.wishes[facts.id] = times(facts.vehicles, () => weights.map((w) => Math.round((100 * w) / most)));
      location.hash = "#preference";
    });
    const tabs = TABS.map((name) => byId(`tab-${name}`));
    tabs.forEach((tab, k) => {
      tab.addEventListener("click", () => (location.hash = `#${TABS[k]}`));
      tab.addEventListener("keydown", ({ key }) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[key];
        if (step) tabs[(k + step + tabs.length) % tabs.length].focus();
      });
    });
    window.addEventListener("hashchange", () => this.follow().catch(showError));
    await this.follow();
  }
  /** Show what the address says: a tab, a drive, or a choice of the explorer. */
  async follow() {
    const name = location.hash.slice(1).split("=")[0];
    const tab = TABS.includes(name) ? name : name ? "explorer" : "drive";
    const same = tab === this.tab;
    this.tab = tab;
    for (const each of TABS) {
      byId(`tab-${each}`).setAttribute("aria-selected", each === tab);
      byId(`tab-${each}`).tabIndex = each === tab ? 0 : -1;
    }
    hide({ stage: tab === "questions" || tab === "explorer", questions: tab !== "questions", content: true });
    showMessage("");
    this.stage.player.stop();
    this.questions.player.stop();
    if (location.hash.startsWith("#drive=")) await this.replay();
    else if (tab === "explorer") await this.explorer();
    else if (tab === "questions") await (this.questions.episodes && !byId("pair").hidden ? this.questions.play() : this.questions.begin());
    else if (!same || tab === "drive") await this.stage.show(tab);
  }

  async replay() {
    const kept = driveOfLink(location.hash);
    const named = (row) => row.id === kept.id && JSON.stringify(row.arguments) === JSON.stringify(kept.arguments);
    const row = this.page.worlds.find(named) ?? this.page.worlds.find(({ id }) => id === kept.id);
    if (!row) throw new Refusal(`This page has no scenario ${kept.id}. Replay the link with mo-deepdrive replay.`);
    this.stage.taken.drive = row.name;
    await this.stage.show("drive", kept);
  }

  async explorer() {
    byId("content").hidden = false;
    if (this.opened) return;
    this.opened = true;
    explore(await load("explorer.json", "text"));
  }
}

if (byId("stage")) new Tabs().start().catch(showError);
else explore(byId("data").textContent);
