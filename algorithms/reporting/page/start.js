// A page with data of fronts in it is the explorer of these alone; without them it is all tabs.

try {
  const fronts = readData(byId("data").textContent);
  byId("content").hidden = false;
  new Explorer(fronts);
} catch (error) {
  byId("content").hidden = true;
  showError(error);
}
