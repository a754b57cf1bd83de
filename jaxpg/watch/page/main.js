// The page from top to bottom; what the data does not have is not there.

const data = JSON.parse(document.getElementById("data").textContent);

function section(title, ...children) {
  return element("section", {}, element("h2", {}, title), ...children);
}

function linkedViews() {
  const view = shared(startOf(data));
  const { player } = data;
  const views = element("div", { class: "views" });
  if (player) views.append(stage(player, view));
  if (data.portrait) views.append(portrait(data.portrait, player, view));
  if (data.workspace) views.append(workspace(data.workspace, player, view));
  if (player) views.append(panels(player, view));
  if (!views.children.length) return [];
  if (!player) return [section("Policy", views)];
  startKeys(player, view);
  return [section("Rollout", choices(player, view), views, keysLine())];
}

function learning() {
  if (!data.curves.length) return [];
  const numberOf = seriesNumbers(data.curves);
  const figures = data.curves.map((panel) => curves(panel, numberOf));
  return [section("Learning", element("div", { class: "figures" }, ...figures))];
}

function start() {
  document.getElementById("kind").textContent = data.kind === "run" ? "training run" : "comparison of runs";
  const main = document.getElementById("main");
  startTheme();
  main.replaceChildren(facts(data.facts), ...linkedViews(), ...learning());
  for (const { title, columns, rows } of data.tables) main.append(section(title, table(title, columns, rows)));
  if (data.improvement) main.append(section("Probability of improvement", ...improvement(data.improvement)));
  for (const [title, rows] of [["Configuration", data.configuration], ["Versions", data.versions]]) {
    if (rows.length) main.append(folded(title, rows));
  }
}

start();
