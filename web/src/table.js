// All names in a table: who may send, who may receive, and what nobody may do.

import { breakable, counted, el, isSmall } from "./dom.js";
import { KINDS, LEVELS, RECEIVES, SENDS, noneText } from "./words.js";

export const SHOWN = 4;
const MOST = 400;
const NONE_SHOWN = "Not among the rows that are shown: search for a name or an enclave.";
// Up to so many rows are looked through without groups, and a group of them needs no folding.
const FEW = 12;
// What usually moves a robot stands first, then what is open to everybody; what only one side may
// use is last.  Each part is in the order of names.
const MOVES = /(^|\/)(cmd_vel|[^/]*commands?$|joint_trajectory|follow_joint_trajectory)/;

const moves = (name) => MOVES.test(name);

// Names that move a robot have rows of their own, also where names with the same rights do not.
export function rowsByMotion(rows) {
  return rows.flatMap((row) => [row.names.filter(moves), row.names.filter((name) => !moves(name))].filter((names) => names.length).map((names) => ({ ...row, names })));
}

export function rank(row) {
  return row.names.some(moves) ? (row.lacks ? 1 : 0) : row.all_send || row.all_receive ? 2 : row.lacks ? 4 : 3;
}

const GROUPS = ["Usually moves the robot:", "Usually moves the robot:", "Open to everybody:"];

// A test whether a row has a name that holds a text.  A label such as {r1…r9} stands for the name
// of each equal unit; one of others, such as {1 other of r1…r9}, may stand for any of them.
function mentions(text, equal) {
  const of = new Map(equal.map(({ label, members }) => [label, new Set(members)]));
  const units = [...of.values()].flatMap((members) => [...members]);
  const holds = (name) => name.toLowerCase().includes(text);
  const ofUnit = (name, unit) => name.replace(/{[^}]*}/g, (label) => (of.get(label)?.has(unit) ?? true ? unit : label));
  const known = new Map();
  function isFound(name) {
    if (!known.has(name)) known.set(name, holds(name) || (name.includes("…") && units.some((unit) => holds(ofUnit(name, unit)))));
    return known.get(name);
  }
  return (row) => [row.names, row.senders, row.receivers, row.denied].some((all) => all.some(isFound));
}

function list(texts, none, all) {
  if (all) return [el("div", { class: "lack", text: all }), ...(texts.length ? list(texts, none) : [])];
  if (!texts.length) return el("span", { class: "soft", text: none });
  return folded(texts.map((text) => el("div", { class: "mono" }, breakable(text))));
}

function folded(items) {
  const rest = items.slice(SHOWN);
  if (!rest.length) return items;
  return [...items.slice(0, SHOWN), el("details", {}, el("summary", { text: `and ${rest.length} more` }), rest)];
}

// What stands directly after the name, such as a colon, never begins a line.
export function nameButton(kind, name, opens, after = "") {
  const open = opens(kind, name);
  const shown = [breakable(name), after && el("span", { class: "after", "aria-hidden": "true", text: after })].flat().filter(Boolean);
  return open ? el("button", { type: "button", class: "link-button", onclick: open }, shown) : el("code", {}, shown);
}

// `opens(kind, name)` returns what shows a name, or nothing if only the table has it; `equal` are the
// units that are drawn as one.
export function namesTable(rows, equal, opens) {
  const lacking = namesIn(rows.filter((row) => row.lacks && !row.common));
  const ordered = rowsByMotion(rows)
    .map((row) => [rank(row), -reach(row), row])
    .sort((a, b) => a[0] - b[0] || a[1] - b[1])
    .map(([, , row]) => row);
  const groups = el("div");
  // A protection that all names have is said once.
  const levels = [...new Set(rows.map((row) => row.level))];
  const same = levels.length === 1 ? ` Protection of all: ${levelText(levels[0])}.` : "";
  const search = el("input", { type: "search", id: "search-names", autocomplete: "off", spellcheck: "false", placeholder: "such as cmd_vel" });
  const only = el("input", { type: "checkbox", id: "only-lacking" });
  const basics = el("input", { type: "checkbox", id: "with-common" });
  const status = el("p", { class: "soft", role: "status" });
  function show() {
    const text = search.value.trim().toLowerCase();
    const found = text ? ordered.filter(mentions(text, equal)) : ordered;
    const fit = found.filter((row) => (basics.checked || !row.common) && (row.lacks || !only.checked));
    const shown = new Set(fit.slice(0, MOST));
    const table = (some) => el("table", { class: "names" }, el("thead", {}, el("tr", {}, heads())), el("tbody", {}, some.map((row) => line(row, opens, !same))));
    const parts = shown.size > FEW ? grouped(fit) : [];
    const part = ([title, all]) => {
      const some = all.filter((row) => shown.has(row));
      return group(title, all, some, some.length ? table(some) : NONE_SHOWN, Boolean(text));
    };
    groups.replaceChildren(...(parts.length > 1 ? parts.map(part) : [table([...shown])]));
    const names = namesIn(fit);
    const shared = names > fit.length ? " (names with the same rights share a row)" : "";
    const once = equal.length ? `; those of equal ${equal[0].what}s count once` : "";
    const first = fit.length > MOST ? `; shown are the first ${MOST}` : "";
    const none = found.length ? "A name matches, but not these choices." : "No name matches.";
    status.textContent = text && !fit.length ? none : `${counted(names, "name")} in ${counted(fit.length, "row")}${shared}${once}${first}.${same}`;
  }
  search.addEventListener("input", show);
  only.addEventListener("change", show);
  basics.addEventListener("change", show);
  const heads = () => ["Name", "May publish or call", "May subscribe or serve", ...(same ? [] : ["Protection"])].map((text) => el("th", { scope: "col", text }));
  show();
  return [
    el("label", { class: "search" }, "Name or enclave ", search),
    el("p", { class: "choices" }, lacking ? el("label", {}, only, ` only names that one side may use (${lacking})`) : null, el("label", {}, basics, " also names that every node needs")),
    status,
    groups,
  ];
}

// How many enclaves may send, and before all of them who may in any namespace.
function reach(row) {
  return row.names.some((name) => /^\/?[^/]*[*?[]/.test(name)) && row.senders.length ? Infinity : row.senders.length;
}

// Rows that are looked at together: what needs a look, and then each namespace.
function grouped(rows) {
  const groups = new Map();
  for (const row of rows) {
    const title = GROUPS[rank(row)] ?? namespaceOf(row);
    if (!groups.has(title)) groups.set(title, []);
    groups.get(title).push(row);
  }
  const place = ([title]) => GROUPS.indexOf(title) + 1 || GROUPS.length + 1;
  return [...groups].sort((a, b) => place(a) - place(b) || a[0].localeCompare(b[0]));
}

function namespaceOf({ names }) {
  const [first, ...others] = new Set(names.map((name) => name.split("/").slice(0, -1)[1]));
  return others.length ? "several namespaces" : first ? `/${first}` : "no namespace";
}

const namesIn = (rows) => rows.reduce((sum, row) => sum + row.names.length, 0);

// A group of which only some rows are shown says so.
function group(title, rows, shown, table, searched) {
  const most = Math.max(...rows.map((row) => row.senders.length));
  const cut = shown.length < rows.length ? `${namesIn(shown)} of ` : "";
  const said = `${cut}${counted(namesIn(rows), "name")}${most > 1 ? `, up to ${most} may send` : ""}`;
  const open = searched || !isSmall() || (GROUPS.includes(title) && shown.length <= FEW);
  return el("details", { class: "group", open }, el("summary", {}, el("b", { text: title }), " ", el("span", { class: "soft", text: said })), table);
}

const levelText = (level) => LEVELS[level].replace("protection ", "");

function line(row, opens, withLevel) {
  const names = row.names.map((name) => el("div", {}, nameButton(row.kind, name, opens)));
  const denied = row.denied.length ? el("div", {}, el("span", { class: "chip", text: "DENY" }), " ", list(row.denied, "")) : null;
  return el(
    "tr",
    {},
    el(
      "th",
      { scope: "row" },
      el("span", { class: "kind", text: KINDS[row.kind] }),
      row.lacks ? [" ", el("span", { class: "chip warning", text: row.lacks })] : null,
      folded(names),
    ),
    el("td", { "data-head": `May ${SENDS[row.kind]}` }, list(row.senders, noneText(row, row.receivers), row.all_send && row.everybody)),
    el("td", { "data-head": `May ${RECEIVES[row.kind]}` }, list(row.receivers, noneText(row, row.senders), row.all_receive && row.everybody), denied),
    withLevel ? el("td", { class: "level", "data-head": "Protection" }, levelText(row.level)) : null,
  );
}
