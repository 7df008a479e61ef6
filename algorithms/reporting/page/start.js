// A page with data of fronts in it is the explorer of these alone; the page of all tabs loads its files when they are needed.

const TABS = ["drive", "preference", "against", "questions", "explorer"];

function explore(text) {
  hide({ content: false });
  try { new Explorer(readData(text)); } catch (error) { hide({ content: true }); showError(error); }
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
    TABS.forEach((name, k) => {
      on(`tab-${name}`, () => (location.hash = `#${name}`));
      byId(`tab-${name}`).addEventListener("keydown", ({ key }) => {
        const step = { ArrowRight: 1, ArrowLeft: TABS.length - 1 }[key];
        if (step) byId(`tab-${TABS[(k + step) % TABS.length]}`).focus();
      });
    });
    window.addEventListener("hashchange", () => this.follow().catch(showError));
    await this.follow();
  }
  /** Show what the address says: a tab, a drive, or a choice of the explorer. */
  async follow() {
    const name = location.hash.slice(1).split("=")[0];
    const tab = TABS.includes(name) ? name : name ? "explorer" : "drive";
    for (const each of TABS) Object.assign(byId(`tab-${each}`), { ariaSelected: String(each === tab), tabIndex: each === tab ? 0 : -1 });
    hide({ stage: tab === "questions" || tab === "explorer", questions: tab !== "questions", content: true });
    showMessage("");
    this.stage.player.stop();
    this.questions.player.stop();
    if (location.hash.startsWith("#drive=")) await this.replay();
    else if (tab === "explorer") await this.explorer();
    else if (tab === "questions") await this.questions.resume();
    else await this.stage.show(tab);
  }

  async replay() {
    const kept = driveOfLink(location.hash);
    const row = this.page.worlds.find(({ id, vehicles }) => id === kept.id && vehicles === kept.actions.length);
    if (!row || JSON.stringify((await load(row.json)).arguments) !== JSON.stringify(kept.arguments)) {
      throw new Refusal(`This page has no scenario ${kept.id} as the link has it. Replay the link with mo-deepdrive replay.`);
    }
    this.stage.taken.drive = row.name;
    await this.stage.show("drive", kept);
  }

  async explorer() {
    const text = await load("explorer.json", "text");
    hide({ content: false });
    if (!this.opened) explore(text);
    this.opened = true;
  }
}

if (byId("stage")) new Tabs().start().catch(showError);
else explore(byId("data").textContent);
