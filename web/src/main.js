// Puts the page together: tabs, search, filters, the map, and what was chosen.

import { MOST_BUNDLES, columns, fitted, flowScene, unwrapped } from "./arrange.js";
import { cardDetails, enclaveDetails, equalDetails, extractNote, findingItem, nameDetails } from "./details.js";
import { breakable, byId, counted, el, isSmall, svg } from "./dom.js";
import { drawScene, legend, onlookerText, withLocks } from "./draw.js";
import { headlines } from "./headlines.js";
import { Model } from "./model.js";
import { namesTable } from "./table.js";
import { timeline } from "./timeline.js";
import { KINDS, LEVELS, markText } from "./words.js";

const model = new Model(JSON.parse(byId("picture").textContent));
const state = { scene: 0, filters: {}, flow: null, chosen: null, zoom: 0, drawing: null, shown: null };
const FILTERS = ["enclave", "namespace", "direction", "protection", "mark"];
const MOST_FOUND = 12;
const MOST_FINDINGS = 100;
const problemsOf = new Map(
  model.enclaves.map((enclave) => [
    enclave.path,
    enclave.problems.length + model.findingsOf(enclave.path).filter((f) => f.severity === "error").length,
  ]),
);
const problems = (card) =>
  card.role === "names" ? 0 : card.members.reduce((sum, path) => sum + (problemsOf.get(path) ?? 0), 0);

// ── the map ──────────────────────────────────────────────────────────────────────────────────

const filtering = () => FILTERS.some((key) => state.filters[key]);

function currentScene() {
  if (state.flow) {
    const { kind, name, upstream, hops } = state.flow;
    const flow = model.flow(kind, name, upstream);
    const most = Math.max(1, ...flow.hops.values());
    const scene = flowScene(flow, upstream, Math.min(hops, most));
    const within = [...flow.hops.values()].filter((hop) => hop <= hops).length;
    const verb = upstream ? "can influence" : "can be influenced by";
    scene.title = `${counted(within, "enclave")} ${verb} ${name} within ${counted(hops, "hop")}`;
    if (within < flow.hops.size) scene.title += `, ${flow.hops.size} over any number`;
    scene.most = most;
    return scene;
  }
  if (filtering()) {
    const bundles = model.filtered({ ...state.filters, common: state.scene > 0 });
    const scene = columns(bundles);
    const names = bundles.reduce((sum, bundle) => sum + bundle.names.length, 0);
    scene.title = `${counted(names, "name")} ${names === 1 ? "fits" : "fit"}`;
    if (bundles.length > MOST_BUNDLES) scene.title += `; drawn are the first ${MOST_BUNDLES} groups of them: filter further`;
    return scene;
  }
  return alone() ?? model.scenes[state.scene];
}

// On a small screen, what was chosen is drawn with its neighbors alone: side by side, they fit.
// Names of equal units have no neighbors in common: they stay in the map.
function alone() {
  const { type, path, kind, name, card } = (isSmall() && state.chosen) || {};
  if (!type || card?.role === "group" || (card && card.role !== "names")) return null;
  const names = card?.members ?? [name];
  const bundle = model.bundle(kind ?? card?.kind, names[0]);
  if (names.some((each) => model.bundle(kind ?? card?.kind, each) !== bundle)) return null;
  const bundles = path
    ? model.filtered({ enclave: path, common: state.scene > 0 }).map((bundle) => ({ ...bundle, ties: bundle.ties.filter((tie) => tie.enclave === path) }))
    : [{ ...bundle, names }];
  return { ...columns(bundles), title: path ? `What ${path} may use` : `Who may use ${names[0]}` };
}

function showMap() {
  const scene = currentScene();
  state.room = roomForMap();
  state.shown = fitted(withLocks(scene), state.room);
  state.drawing = drawScene(byId("map"), state.shown, { overlay: model.overlay, problems, choose });
  byId("legend").replaceChildren(...legend(state.shown, model.overlay, model.equal, { el, svg }));
  const why = scene.id === "essential" ? " that every node needs (parameters, log, time)" : "";
  const { same, onlookers } = state.shown;
  const all = same && same !== "unknown" ? `, all ${LEVELS[same].replace("protection ", "")}` : "";
  const summary = scene.shown
    ? `${counted(model.enclaves.length, "enclave")}, ${counted(scene.shown, "name")}${all}${scene.hidden ? `; left out: ${counted(scene.hidden, "name")}${why}` : ""}`
    : `${scene.title}${all}`;
  const said = [summary, ...onlookers.map((onlooker) => `${onlooker.tag}: ${onlookerText(onlooker)}`)];
  byId("summary").textContent = scene.cards.length ? said.join("; ") : "Nothing fits.";
  byId("back").hidden = scene === model.scenes[state.scene];
  byId("hops").hidden = !state.flow;
  if (state.flow) byId("hops-number").textContent = counted(Math.min(state.flow.hops, scene.most), "hop");
  zoom(0);
  light();
  showFocus();
  showViolation();
}

// The first line that breaks a requirement, unless something else was asked for.
const violation = () => (state.flow || state.chosen || filtering() ? null : byId("map").querySelector(".violates"));

// What breaks a requirement is in sight, and so are the headlines.
function showViolation() {
  const canvas = byId("canvas");
  const broken = violation()?.getBoundingClientRect();
  if (!broken) return;
  const room = canvas.getBoundingClientRect();
  canvas.scrollTop += broken.top + broken.height / 2 - room.top - room.height / 2;
}

// What was asked about is in sight.
function showFocus() {
  const { cards, id } = state.shown;
  const asked = id === "focus" && cards.find((card) => card.chosen);
  if (!asked) return;
  const canvas = byId("canvas");
  const middle = (asked.x + asked.width / 2) * state.zoom - canvas.clientWidth / 2;
  // Where not all fits, who may send is in sight: their frame stands out by 8.
  const links = state.shown.links.filter((link) => link.target === asked.id);
  const senders = cards.filter((card) => links.some((link) => link.source === card.id));
  canvas.scrollLeft = Math.min(middle, ...senders.map((card) => (card.x - 12) * state.zoom));
  canvas.scrollTop = (asked.y + asked.height / 2) * state.zoom - canvas.clientHeight / 2;
}

const roomForMap = () => byId("canvas").clientWidth - 2;

// Draws the map again where another width is left for it.
function resized() {
  if (roomForMap() === state.room || byId("panel-map").hidden) return;
  showMap();
}

function zoom(step) {
  const { width } = state.shown;
  if (step === 0) state.zoom = Math.min(1.15, Math.max(1, state.room / width));
  else state.zoom = Math.min(2.5, Math.max(0.05, state.zoom * (step > 0 ? 1.2 : 1 / 1.2)));
  byId("map").setAttribute("width", Math.round(width * state.zoom));
  byId("map").setAttribute("height", Math.round(state.shown.height * state.zoom));
  fadeEdges();
}

// A side on which the map goes on fades, so that one moves it.
function fadeEdges() {
  const canvas = byId("canvas");
  canvas.classList.toggle("more-left", canvas.scrollLeft > 4);
  canvas.classList.toggle("more-right", canvas.scrollLeft + canvas.clientWidth < canvas.scrollWidth - 4);
}

// The whole drawing, however small; what opens first is as wide as the window, and readable.
function fit() {
  const { width, height } = state.shown;
  const canvas = byId("canvas");
  const tall = Math.min(canvas.clientHeight, window.innerHeight) - 4;
  state.zoom = Math.max(0.05, Math.min(1.15, (canvas.clientWidth - 2) / width, tall / height));
  byId("map").setAttribute("width", Math.floor(width * state.zoom));
  byId("map").setAttribute("height", Math.floor(height * state.zoom));
  fadeEdges();
  canvas.scrollIntoView({ block: "nearest" });
}

function light() {
  const chosen = state.chosen;
  const belongs = chosen && {
    enclave: (card) => card.role !== "names" && card.members.includes(chosen.path),
    name: (card) => card.role === "names" && card.kind === chosen.kind && card.members.includes(chosen.name),
    card: (card) => (card.role === "names") === (chosen.card.role === "names") && card.kind === chosen.card.kind && card.members[0] === chosen.card.members[0],
  }[chosen.type];
  // In a flow everything belongs to what was asked for.
  const isLit = state.drawing.highlight(state.flow ? null : belongs);
  if (!isLit && !state.flow) return;
  const card = state.drawing.card(belongs ?? ((card) => card.chosen));
  // On a small screen, the details lie over the lower half.
  card?.scrollIntoView({ block: isSmall() ? "center" : "nearest", inline: "nearest" });
}

// ── choosing ─────────────────────────────────────────────────────────────────────────────────

const act = {
  enclave: (path) => chosen({ type: "enclave", path }),
  name: (kind, name) => chosen({ type: "name", kind, name }),
  only: (path) => {
    clear();
    setFilter("enclave", path);
  },
  finding: (id, at) => {
    showTab("findings");
    const item = state.items.get(textOf(model.findings.filter((finding) => finding.id === id)[at]));
    if (!item?.isConnected) byId("more-findings")?.click();
    item?.focus();
    item?.scrollIntoView({ block: "nearest" });
  },
  flow: (kind, name, upstream) => {
    clear();
    state.flow = { kind, name, upstream, hops: 2 };
    unfoldSheet(false);
    showTab("map");
    showMap();
  },
};

function choose(card) {
  if (card.role === "group") {
    const at = model.scenes.findIndex((scene) => scene.id === `group ${card.id.slice(2)}`);
    if (at >= 0) setScene(at);
    return;
  }
  if (card.role === "enclave" && card.members.length === 1) act.enclave(card.members[0]);
  else if (card.members.length === 1) act.name(card.kind, card.members[0]);
  else chosen({ type: "card", card });
}

function chosen(what) {
  state.chosen = what;
  const content = {
    enclave: () => enclaveDetails(model, what.path, act),
    name: () => nameDetails(model, what.kind, what.name, act),
    card: () => (what.card.role === "names" ? cardDetails : equalDetails)(what.card, act),
  }[what.type]();
  byId("details-content").replaceChildren(...content);
  document.body.classList.add("with-details");
  unfoldSheet(true);
  if (byId("details").hidden) {
    state.opener = document.activeElement;
    state.scrolled = window.scrollY;
    byId("details").hidden = false;
  }
  byId("details").scrollTop = 0;
  byId("details-content").querySelector("h2").focus({ preventScroll: true });
  if (isSmall() || roomForMap() !== state.room) showMap();
  else light();
}

// On a small screen, the details are a sheet, of which only the title shows while one looks at a flow.
function unfoldSheet(open) {
  document.body.classList.toggle("with-title-only", !open);
  byId("sheet").setAttribute("aria-expanded", String(open));
}

function close() {
  const was = state.chosen;
  state.chosen = null;
  byId("details").hidden = true;
  document.body.classList.remove("with-details");
  if (was && isSmall()) {
    showMap();
    window.scrollTo(0, state.scrolled);
  } else {
    resized();
    light();
  }
  const opener = state.opener?.checkVisibility() ? state.opener : (state.opener && state.drawing.again(state.opener)) || document.querySelector("#map [tabindex='0']");
  if (was) opener?.focus({ preventScroll: true });
}

function clear() {
  state.flow = null;
  state.filters = {};
  for (const key of FILTERS) if (byId(`filter-${key}`)) byId(`filter-${key}`).value = "";
}

function setScene(at) {
  clear();
  state.scene = at;
  byId("scene").value = String(at);
  showMap();
}

function setFilter(key, value) {
  state.flow = null;
  state.filters[key] = value;
  if (byId(`filter-${key}`).value !== value) byId(`filter-${key}`).value = value;
  showTab("map");
  showMap();
}

// ── search, filters, tabs ────────────────────────────────────────────────────────────────────

function search() {
  const text = byId("search").value;
  const { enclaves, names, more } = model.search(text, MOST_FOUND);
  const item = (kind, label, onclick) =>
    el("li", {}, el("button", { type: "button", onclick }, el("span", { class: "kind", text: kind }), el("span", { class: "mono" }, breakable(label))));
  const items = [
    ...enclaves.map((enclave) => item("enclave", enclave.path, () => pick(() => act.enclave(enclave.path)))),
    ...names.map((name) => item(KINDS[name.kind], name.name, () => pick(() => act.name(name.kind, name.name)))),
  ];
  if (more) items.push(el("li", { class: "soft", text: `and ${more} more: type on` }));
  if (text.trim() && !items.length) items.push(el("li", { class: "soft", text: "No name matches." }));
  byId("results").replaceChildren(...items);
  byId("results").hidden = !items.length;
  byId("search-status").textContent = text.trim() ? `${enclaves.length + names.length + more} found` : "";
}

function pick(then) {
  byId("results").hidden = true;
  then();
}

function options(id, pairs) {
  byId(id).replaceChildren(...pairs.map(([value, text]) => el("option", { value, text })));
}

function showTab(name) {
  for (const tab of document.querySelectorAll("[role=tab]")) {
    const on = tab.id === `tab-${name}`;
    tab.setAttribute("aria-selected", String(on));
    tab.tabIndex = on ? 0 : -1;
    byId(tab.getAttribute("aria-controls")).hidden = !on;
  }
  document.body.dataset.tab = name;
  if (name === "map" && state.drawing) resized();
}

function tabKeys(event) {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const tabs = [...document.querySelectorAll("[role=tab]:not([hidden])")];
  const next = tabs[(tabs.indexOf(event.target) + step + tabs.length) % tabs.length];
  showTab(next.id.replace("tab-", ""));
  next.focus();
}

// What findings have in common that are shown as one.
const textOf = ({ enclave, ...finding }) => JSON.stringify(finding);

function fillLists() {
  const order = { error: 0, warning: 1, note: 2 };
  const sorted = [...model.findings].sort((a, b) => order[a.severity] - order[b.severity]);
  const none = el("p", { class: "soft", text: "There are no findings." });
  const same = new Map();
  for (const finding of sorted) {
    const key = textOf(finding);
    if (!same.has(key)) same.set(key, { finding, enclaves: [] });
    if (finding.enclave) same.get(key).enclaves.push(finding.enclave);
  }
  state.items = new Map([...same].map(([key, { finding, enclaves }]) => [key, findingItem(finding, enclaves, act.enclave)]));
  const items = [...state.items.values()];
  const list = el("ul", { class: "plain cards" }, items.slice(0, MOST_FINDINGS));
  if (items.length > MOST_FINDINGS) {
    const rest = items.slice(MOST_FINDINGS);
    const more = el("button", { type: "button", id: "more-findings", text: `Show ${rest.length} more` });
    more.addEventListener("click", () => more.parentElement.replaceWith(...rest));
    list.append(el("li", {}, more));
  }
  byId("findings").replaceChildren(sorted.length ? list : none);
  byId("tab-findings").textContent = sorted.length ? `Findings (${sorted.length})` : "Findings";
  // A name that stands for several is a card of the first scene.
  const opens = (kind, name) => {
    if (model.bundle(kind, name)) return () => act.name(kind, name);
    const card = model.scenes[0].cards.find((each) => each.kind === kind && unwrapped(each.lines).includes(name));
    return card && (() => choose(card));
  };
  byId("headlines").replaceChildren(...headlines(model, opens, act, showTab));
  byId("headlines").hidden = !byId("headlines").children.length;
  byId("names").replaceChildren(...extractNote(model), ...namesTable(model.rows, model.equal, opens));
  byId("timeline").replaceChildren(...timeline(model.validities, act.enclave));
  byId("tab-differences").hidden = !model.overlay;
  if (!model.overlay) return;
  const differences = model.differences.map((difference) =>
    el(
      "li",
      {},
      el("span", { class: `chip ${difference.mark}`, text: markText(model.overlay, difference.mark) }),
      " ",
      el("code", { text: difference.text }),
      difference.notes.length ? el("span", { class: "soft", text: ` (${difference.notes.join("; ")})` }) : null,
    ),
  );
  const equal = el("p", { class: "soft", text: "There is no difference." });
  byId("differences").replaceChildren(differences.length ? el("ul", { class: "plain differences" }, differences) : equal);
  byId("tab-differences").textContent = `Differences (${differences.length})`;
}

function start() {
  const any = (text) => ["", text];
  options("scene", model.scenes.map((scene, at) => [String(at), scene.title]));
  byId("scene-label").hidden = model.scenes.length < 2;
  options("filter-enclave", [any("every enclave"), ...model.enclaves.map(({ path }) => [path, path])]);
  options("filter-namespace", [any("every namespace"), ...model.namespaces.filter((ns) => ns !== "/").map((ns) => [ns, ns])]);
  options("filter-direction", [any("both directions"), ["send", "may publish or call"], ["receive", "may subscribe or serve"], ["deny", "denied"]]);
  const levels = [...new Set(model.bundles.map((bundle) => bundle.protection.level))];
  options("filter-protection", [any("every protection"), ...levels.map((level) => [level, LEVELS[level]])]);
  document.body.dataset.overlay = model.overlay?.kind ?? "";
  byId("mark-label").hidden = !model.overlay;
  if (model.overlay) {
    options("filter-mark", [any("all rights"), ["first", model.overlay.first], ["second", model.overlay.second], ["both", "on both sides"]]);
  }
  byId("scene").addEventListener("change", (event) => setScene(Number(event.target.value)));
  for (const key of FILTERS) {
    byId(`filter-${key}`).addEventListener("change", (event) => setFilter(key, event.target.value));
  }
  byId("search").addEventListener("input", search);
  byId("search").addEventListener("keydown", (event) => {
    if (event.key === "ArrowDown" || event.key === "Enter") {
      const first = byId("results").querySelector("button");
      if (first && event.key === "Enter") first.click();
      else first?.focus();
      event.preventDefault();
    }
  });
  byId("back").addEventListener("click", () => {
    if (isSmall()) close();
    setScene(state.scene);
    document.querySelector("#map [tabindex='0']")?.focus({ preventScroll: true }); // the button is gone
  });
  byId("close").addEventListener("click", close);
  byId("sheet").addEventListener("click", () => unfoldSheet(document.body.classList.contains("with-title-only")));
  byId("canvas").addEventListener("scroll", fadeEdges);
  byId("zoom-in").addEventListener("click", () => zoom(1));
  byId("zoom-out").addEventListener("click", () => zoom(-1));
  byId("zoom-fit").addEventListener("click", fit);
  byId("hops-more").addEventListener("click", () => hop(1));
  byId("hops-less").addEventListener("click", () => hop(-1));
  byId("print").addEventListener("click", () => window.print());
  byId("theme").addEventListener("change", (event) => {
    document.documentElement.dataset.theme = event.target.value;
  });
  for (const tab of document.querySelectorAll("[role=tab]")) {
    tab.addEventListener("click", () => {
      showTab(tab.id.replace("tab-", ""));
      if (!isSmall()) return;
      tab.parentElement.scrollIntoView();
      if (tab.id === "tab-map") violation()?.scrollIntoView({ block: "center", inline: "nearest" });
    });
    tab.addEventListener("keydown", tabKeys);
  }
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") {
      if (byId("results").hidden) return close();
      byId("results").hidden = true;
      byId("search").focus();
    }
    if (event.key === "/" && !/^(INPUT|SELECT|TEXTAREA)$/.test(document.activeElement.tagName)) {
      event.preventDefault();
      byId("search").focus();
    }
  });
  window.addEventListener("resize", resized);
  window.addEventListener("beforeprint", unfoldAll);
  window.addEventListener("afterprint", foldAgain);
  // A small screen has no room for the columns of the whole map; the table and the differences fit.
  if (isSmall()) for (const fold of document.querySelectorAll(".fold")) fold.open = false;
  fillLists();
  showTab(!isSmall() || model.scenes[0].id === "focus" ? "map" : model.differences.length ? "differences" : "names");
  showMap();
  if (startsWithoutEnclaves()) showTab("names");
  document.body.dataset.ready = "true";
}

// On paper nothing can be unfolded.
function unfoldAll() {
  state.folded = [...document.querySelectorAll("details:not([open])")];
  for (const each of state.folded) each.open = true;
}

function foldAgain() {
  for (const each of state.folded) each.open = false;
}

// The top of a long map may have names only; then the table says more.
function startsWithoutEnclaves() {
  const { id, cards } = state.shown;
  const tops = cards.filter((card) => card.role !== "names").map((card) => card.y);
  return id === "essential" && !model.overlay && !model.requirements?.violations.length && Math.min(...tops) * state.zoom > byId("canvas").clientHeight;
}

function hop(step) {
  state.flow.hops = Math.max(1, Math.min(state.shown.most, state.flow.hops + step));
  showMap();
}

start();
