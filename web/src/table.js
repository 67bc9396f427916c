// All names in a table: who may send, who may receive, and what nobody may do.

import { counted, el } from "./dom.js";
import { KINDS, LEVELS } from "./words.js";

const SHOWN = 4;
const MOST = 400;

function list(texts, none) {
  if (!texts.length) return el("span", { class: "soft", text: none });
  const rest = texts.length - SHOWN;
  return [
    ...texts.slice(0, SHOWN).map((text) => el("div", { class: "mono", text })),
    rest > 0 ? el("div", { class: "soft", text: `and ${rest} more` }) : null,
  ].filter(Boolean);
}

// `lacking` is the number of names that only one side may use;
// `opens(kind, name)` returns what shows a name, or nothing for one that stands for several.
export function namesTable(rows, lacking, opens) {
  const body = el("tbody");
  const only = el("input", { type: "checkbox", id: "only-lacking" });
  const basics = el("input", { type: "checkbox", id: "with-common" });
  const status = el("p", { class: "soft", role: "status" });
  function show() {
    const fit = rows.filter((row) => (basics.checked || !row.common) && (row.lacks || !only.checked));
    body.replaceChildren(...fit.slice(0, MOST).map((row) => line(row, opens)));
    status.textContent = fit.length > MOST ? `The first ${MOST} of ${fit.length} rows.` : counted(fit.length, "row");
  }
  only.addEventListener("change", show);
  basics.addEventListener("change", show);
  show();
  const head = ["Name", "May send", "May receive", "Protection"].map((text) => el("th", { scope: "col", text }));
  return [
    el("p", {}, lacking ? `${counted(lacking, "name")} may be used by one side only.` : "Every name has a sender and a receiver."),
    el("p", { class: "choices" }, el("label", {}, only, " only names without a sender or a receiver"), el("label", {}, basics, " also names that every node needs")),
    status,
    el("table", { class: "names" }, el("thead", {}, el("tr", {}, head)), body),
  ];
}

function line(row, opens) {
  const rest = row.names.length - SHOWN;
  const names = row.names.slice(0, SHOWN).map((name) => {
    const open = opens(row.kind, name);
    const link = open && el("button", { type: "button", class: "link-button", text: name, onclick: open });
    return el("div", {}, link || el("code", { text: name }));
  });
  const denied = row.denied.length ? el("div", {}, el("span", { class: "chip deny", text: "DENY" }), " ", list(row.denied, "")) : null;
  return el(
    "tr",
    {},
    el(
      "th",
      { scope: "row" },
      el("span", { class: "kind", text: KINDS[row.kind] }),
      row.lacks ? [" ", el("span", { class: "chip warning", text: row.lacks })] : null,
      names,
      rest > 0 ? el("div", { class: "soft", text: `and ${rest} more` }) : null,
    ),
    el("td", { "data-head": "May send" }, list(row.senders, "nobody")),
    el("td", { "data-head": "May receive" }, list(row.receivers, "nobody"), denied),
    el("td", { "data-head": "Protection" }, LEVELS[row.level].replace("protection ", "")),
  );
}
