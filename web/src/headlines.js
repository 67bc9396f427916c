// What the page claims before anything else: its answers, who may drive the robot, or else who may do
// most, and what permissions do not control.

import { counted, el } from "./dom.js";
import { SHOWN, nameButton, rank, rowsByMotion } from "./table.js";
import { daysLeft } from "./timeline.js";
import { SENDS, noneText, sends } from "./words.js";

const DRIVERS = 3;
const VIOLATED = "requirement.violated";
const ASSUMED = "requirement.assumed";

function button(text, onclick) {
  return el("button", { type: "button", class: "link-button words", text, onclick });
}

// `opens(kind, name)` returns what shows a name; `act.enclave` shows an enclave, `act.finding` the one
// at a place among those with an id, and `showTab` the names or differences that are only counted.
export function headlines(model, opens, act, showTab) {
  const showTable = () => showTab("names");
  const parts = [requirementLines(model, act.finding), model.headlines.map((text) => el("p", { text: `${text}.` }))].flat();
  // A focus has its own answer, and in a comparison there are two.
  if (model.overlay) parts.push(differencesLine(model, () => showTab("differences")));
  else if (model.scenes[0].id !== "focus") {
    const said = drivers(model.rows, opens, showTable);
    const widest = said.length ? [] : widestLine(model, act);
    const lines = [...said, ...widest, wrongLine(model, showTab)];
    const isStated = model.bundles.some(({ protection }) => protection.data);
    if (isStated) lines.unshift(openLine(model, showTable));
    else lines.push(el("p", { class: "soft", text: "What strangers may do is not stated here: a keystore's governance says it." }));
    parts.push(el("div", { class: "drivers" }, lines));
  }
  const [first, ...rest] = model.notes;
  if (rest.length) {
    const summary = `${first}; ${counted(rest.length, "more note")} on the drawing`;
    parts.push(el("details", { class: "notes" }, el("summary", { text: summary }), rest.map((text) => el("p", { text: `${text}.` }))));
  } else if (first) parts.push(el("p", { class: "notes", text: `${first}.` }));
  return parts;
}

// Violations are said in short: the findings say all of each, and what was assumed for the others.
function requirementLines({ requirements }, showFinding) {
  if (!requirements) return [];
  const { hold, violations, assumed } = requirements;
  const number = violations.length;
  const all = counted(hold + number, "requirement");
  const some = number ? `; ${assumed} of the others hold${assumed === 1 ? "s" : ""}` : `, ${assumed} of them`;
  const under = assumed ? [`${some} only `, button("under an assumption", () => showFinding(ASSUMED, 0))] : "";
  if (!number) return [el("p", { class: "drivers" }, `${all} hold${hold === 1 ? "s" : ""}`, under)];
  const lines = violations.slice(0, DRIVERS).map((text, at) => el("p", { class: "violated" }, button(text, () => showFinding(VIOLATED, at))));
  if (number > DRIVERS) lines.push(el("p", {}, button(`and ${number - DRIVERS} more`, () => showFinding(VIOLATED, DRIVERS))));
  return [el("p", { class: "drivers" }, el("b", { class: "violated" }, button(`${number} of ${all} violated`, () => showFinding(VIOLATED, 0))), under), ...lines];
}

function differencesLine({ overlay, differences }, showDifferences) {
  const number = (mark) => differences.filter((difference) => difference.mark === mark).length;
  const sides = ["first", "second"].filter(number).map((mark) => `${number(mark)} ${overlay[mark]}`);
  if (!sides.length) return el("p", { text: "There is no difference." });
  return el("p", { class: "drivers" }, button(counted(differences.length, "difference"), showDifferences), `: ${sides.join("; ")}`);
}

// Who may drive the robot; where nothing is known to move it, who may use its names if they are few.
function drivers(rows, opens, showTable) {
  const known = rowsByMotion(rows).filter((row) => rank(row) < 2).sort((a, b) => rank(a) - rank(b));
  // That nobody drives is said where nobody drives at all.
  const driven = known.filter((row) => row.all_send || row.senders.length);
  const moving = driven.length ? driven : known;
  const own = rows.filter((row) => !row.common);
  const few = own.length <= DRIVERS ? own : [];
  const shown = moving.length ? moving : few;
  const said = shown.slice(0, DRIVERS).map((row) => {
    const [name, ...alike] = row.names;
    const all = [...(row.all_send ? [row.everybody] : []), ...row.senders];
    const more = all.length > SHOWN ? ` and ${all.length - SHOWN} more` : "";
    const who = all.length ? `${all.slice(0, SHOWN).join(", ")}${more}` : noneText(row, row.receivers);
    const moreNames = alike.length ? ` and ${alike.length} more: ` : " ";
    return el("p", {}, `May ${SENDS[row.kind]} `, nameButton(row.kind, name, opens, alike.length ? "" : ":"), `${moreNames}${who}`);
  });
  const left = shown.length - said.length;
  return left ? [...said, el("p", {}, button(`and ${left} more in the table`, showTable))] : said;
}

// Which enclaves may use most names, apart from those that every node needs.
function widestLine(model, act) {
  const names = new Set();
  const used = { true: new Map(), false: new Map() };
  for (const bundle of model.bundles) {
    for (const tie of bundle.ties) {
      if (tie.common) continue;
      for (const name of bundle.names) names.add(`${bundle.kind} ${name}`);
      if (tie.deny) continue;
      const of = used[sends(tie)];
      if (!of.has(tie.enclave)) of.set(tie.enclave, new Set());
      of.get(tie.enclave).add(bundle);
    }
  }
  const most = (isSending, verbs) => {
    const numbers = [...used[isSending]].map(([path, bundles]) => [path, [...bundles].reduce((sum, { names: own }) => sum + own.length, 0)]);
    const top = Math.max(0, ...numbers.map(([, number]) => number));
    const [first, ...others] = numbers.filter(([, number]) => number === top).map(([path]) => path);
    if (!first) return null;
    const also = others.length ? ` and ${others.length} more` : "";
    return el("p", {}, `May ${verbs} most names (${top} of ${names.size}): `, button(first, () => act.enclave(first)), also);
  };
  return [most(true, "publish or call"), most(false, "subscribe to or serve")].filter(Boolean);
}

// What looks wrong: the worst finding, how many others there are, and what expired since the page was made.
function wrongLine({ findings: all, requirements, validities, unread }, showTab) {
  const findings = all.filter(({ id }) => id !== VIOLATED);
  const of = (severity) => findings.filter((finding) => finding.severity === severity);
  const [errors, warnings, notes] = ["error", "warning", "note"].map(of);
  const expired = validities.filter((validity) => daysLeft(validity) < 0);
  const [worst] = [...errors, ...warnings];
  const number = [errors.length && counted(errors.length, "error"), warnings.length && counted(warnings.length, "warning")];
  const parts = [
    worst && [button(number.filter(Boolean).join(", "), () => showTab("findings")), ` (${[worst.enclave, worst.text].filter(Boolean).join(": ")})`],
    expired.length && [button(`${expired.length} expired`, () => showTab("timeline"))],
  ].filter(Boolean);
  if (parts.length) return el("p", { class: "lack" }, "Looks wrong: ", parts.flatMap((part, at) => (at ? [", ", ...part] : part)));
  const unchecked = findings.find(({ id }) => id === "view.not-checked");
  if (unchecked) return el("p", { class: "lack" }, "Not all was checked: ", button(counted(notes.length, "note"), () => showTab("findings")));
  if (requirements?.violations.length) return null;
  const read = unread ? " in the enclaves that were read" : "";
  return el("p", {}, `No error or warning was found${read}`, notes.length ? [", but ", button(counted(notes.length, "note"), () => showTab("findings"))] : "", ".");
}

// What may be used without a right.  Only a keystore's governance says it, and only of DDS.
function openLine(model, showTable) {
  const open = model.bundles.filter(({ protection }) => !protection.read_control || !protection.write_control);
  const number = open.reduce((sum, bundle) => sum + bundle.names.length, 0);
  if (!number) return el("p", { text: "On DDS, strangers, who have no identity, may use none of these names, and enclaves only those that they have a right to." });
  const who = open.some(({ protection }) => protection.strangers) ? "everybody, even without an identity," : "everybody with an identity";
  return el("p", { class: "lack" }, `On DDS, ${who} may use some names without a right: `, button(counted(number, "name"), showTable));
}
