// What is known of the enclave or the name that was chosen.

import { unwrapped } from "./arrange.js";
import { breakable, counted, el } from "./dom.js";
import { byRight, sends } from "./model.js";
import { KINDS, LEVELS, RECEIVES, SENDS, markText, noneText } from "./words.js";
import { daysLeft, dateText, leftText } from "./timeline.js";

const VERBS = {
  publish: "May publish",
  subscribe: "May subscribe",
  request: "May call",
  reply: "May serve",
  call: "May call",
  execute: "May execute",
};
const MOST = 60;

function chip(kind, text) {
  return el("span", { class: `chip ${kind}`, text });
}

export function chips(model, tie) {
  const shown = [];
  if (tie.deny) shown.push(chip("", "DENY"));
  const marked = markText(model.overlay, tie.mark);
  if (marked) shown.push(chip(tie.mark, marked));
  if (tie.by?.length) shown.push(chip("", `by ${tie.by.join(", ")}`));
  if (tie.parts?.length) shown.push(chip("", `only ${tie.parts.join(", ")}`));
  if (tie.violates) shown.push(chip("error", "breaks a requirement"));
  if (tie.common) shown.push(chip("", "as every node"));
  return shown;
}

function link(text, onclick) {
  return el("button", { type: "button", class: "link-button", onclick }, breakable(text));
}

function section(title, ...content) {
  return el("section", {}, el("h3", { text: title }), ...content);
}

function facts(pairs) {
  const rows = pairs.filter(([, value]) => value);
  return el(
    "dl",
    {},
    rows.flatMap(([key, value]) => [el("dt", { text: key }), el("dd", { text: value })]),
  );
}

function longList(items) {
  if (items.length <= MOST) return el("ul", { class: "plain" }, items);
  const rest = el("ul", { class: "plain" }, items.slice(MOST));
  const more = el("details", {}, el("summary", { text: `${items.length - MOST} more` }), rest);
  return el("div", {}, el("ul", { class: "plain" }, items.slice(0, MOST)), more);
}

// Backticks mark commands; options, and an arrow such as `-publish /x->`, are not broken at hyphens.
export const commands = (text) => text.split("`").map((part, at) => (at % 2 ? el("code", {}, unbroken(part)) : unbroken(part)));
const unbroken = (text) => text.split(/(-+(?:>|\w[\w-]*))/).map((part, at) => (at % 2 ? el("span", { class: "unbroken", text: part }) : part));

// A finding; `enclaves` are all that have this very finding, each with a link.
export function findingItem(finding, enclaves = [], onEnclave = null) {
  const links = enclaves.map((path) => el("li", {}, link(path, () => onEnclave(path))));
  const many = links.length > 1;
  return el(
    "li",
    { class: `finding ${finding.severity}`, tabindex: "-1" },
    el("span", { class: `chip ${finding.severity}`, text: finding.severity }),
    " ",
    el("code", { text: finding.id }),
    many ? el("details", {}, el("summary", { text: `${links.length} enclaves` }), el("ul", { class: "plain" }, links)) : null,
    el("p", {}, links.length === 1 ? [link(enclaves[0], () => onEnclave(enclaves[0])), ": "] : [], commands(finding.text)),
    finding.remedy ? el("p", { class: "soft" }, commands(finding.remedy)) : null,
  );
}

export const extractNote = (model) => (model.extract ? [el("p", { class: "soft", text: model.extract })] : []);

export function enclaveDetails(model, path, act) {
  const enclave = model.enclave.get(path);
  const ties = model.tiesOf.get(path).filter(({ tie }) => !tie.common);
  const common = model.tiesOf.get(path).length - ties.length;
  const findings = model.findingsOf(path);
  const parts = [
    el("p", { class: "kind", text: "Enclave" }),
    el("h2", { text: path, tabindex: "-1" }),
    ...extractNote(model),
    el(
      "p",
      { class: "actions" },
      el("button", { type: "button", text: "Show only its part of the map", onclick: () => act.only(path) }),
    ),
  ];
  if (model.overlay?.kind === "use") {
    const all = ties.filter(({ tie }) => !tie.deny);
    const count = (mark) => all.filter(({ tie }) => tie.mark === mark).reduce((n, { bundle }) => n + bundle.names.length, 0);
    const used = count("both");
    parts.push(el("p", { class: "figure", text: `allowed ${used + count("first")}, observed ${used}` }));
  }
  if (enclave.problems.length) {
    const items = enclave.problems.map((text) => el("li", { class: "finding error", text }));
    parts.push(section("It cannot be used", el("ul", { class: "plain" }, items)));
  }
  if (findings.length) {
    parts.push(section("Findings", el("ul", { class: "plain" }, findings.map((finding) => findingItem(finding)))));
  }
  for (const [right, group] of byRight(ties)) {
    const names = group.flatMap(({ tie, bundle }) =>
      bundle.names.map((name) => ({ tie, kind: bundle.kind, name })),
    );
    names.sort((a, b) => (a.name < b.name ? -1 : 1));
    const deny = right.startsWith("DENY ");
    const title = deny ? `Denied: ${right.slice(5)}` : VERBS[right];
    const items = names.map(({ tie, kind, name }) =>
      el("li", {}, link(name, () => act.name(kind, name)), " ", chips(model, { ...tie, deny: false })),
    );
    parts.push(section(`${title} (${names.length})`, longList(items)));
  }
  if (common) parts.push(el("p", { class: "soft", text: "In addition, all rights that every node needs to start." }));
  const written = enclave.statements;
  if (written.length) {
    const items = written.map((statement) =>
      el(
        "li",
        {},
        el("code", { text: `${statement.deny ? "DENY " : ""}${statement.right} ${statement.name}` }),
        ` fits ${counted(statement.reaches, "name")} on this page, and every other name of this form`,
      ),
    );
    parts.push(section("Wildcards as written", el("ul", { class: "plain" }, items)));
  }
  const validities = model.validitiesOf(path);
  if (validities.length) {
    const items = validities.map((validity) =>
      el(
        "li",
        {},
        el("b", { text: validity.kind }),
        ` ${dateText(validity.not_before)} to ${dateText(validity.not_after)} `,
        chip(daysLeft(validity) < 0 ? "error" : daysLeft(validity) < 30 ? "warning" : "", leftText(validity)),
      ),
    );
    parts.push(section("Validity", el("ul", { class: "plain" }, items)));
  }
  const identity = facts([
    ["Group", enclave.group],
    ["Nodes", enclave.nodes.join(", ")],
    ["Certificate", enclave.subject],
    ["Issued by", enclave.issuer],
    ["Serial number", enclave.serial],
    ["Key", enclave.key],
  ]);
  if (identity.childElementCount) parts.push(section("Identity", identity));
  return parts;
}

export function nameDetails(model, kind, name, act) {
  const bundle = model.bundle(kind, name);
  const { protection } = bundle;
  const hasFlow = kind !== "dds";
  const parts = [
    el("p", { class: "kind", text: KINDS[kind] }),
    el("h2", { text: name, tabindex: "-1" }),
    ...extractNote(model),
    el(
      "p",
      { class: "actions" },
      hasFlow ? el("button", { type: "button", text: "Who can influence it", onclick: () => act.flow(kind, name, true) }) : null,
      hasFlow ? el("button", { type: "button", text: "Whom it influences", onclick: () => act.flow(kind, name, false) }) : null,
    ),
  ];
  if (bundle.lacks) parts.push(el("p", {}, chip("warning", bundle.lacks)));
  if (bundle.open) parts.push(el("p", {}, chip("warning", bundle.open)));
  for (const [title, wanted, controlled] of [
    [`May ${SENDS[kind]}`, (tie) => !tie.deny && sends(tie), protection.write_control],
    [kind === "actions" ? "May execute or subscribe" : `May ${RECEIVES[kind]}`, (tie) => !tie.deny && !sends(tie), protection.read_control],
    ["Denied", (tie) => tie.deny, true],
  ]) {
    const ties = bundle.ties.filter(wanted);
    const allowed = bundle.ties.filter((tie) => !tie.deny);
    if (!ties.length && title === "Denied") continue;
    const items = ties.map((tie) =>
      el(
        "li",
        {},
        link(tie.enclave, () => act.enclave(tie.enclave)),
        " ",
        title === "Denied" || tie.parts.length ? chip("", tie.right) : null,
        " ",
        chips(model, { ...tie, deny: false }),
      ),
    );
    const nobody = el("p", { class: "soft", text: controlled ? noneText(bundle, allowed, "Nobody.") : "Nobody is named." });
    const everybody = controlled ? null : el("p", { text: `It is open to ${bundle.everybody}; permissions allow it to:` });
    const heading = controlled ? `${title} (${ties.length})` : `${title} (everybody)`;
    parts.push(section(heading, ...[everybody, ties.length ? longList(items) : nobody].filter(Boolean)));
  }
  const level = facts([
    ["Level", LEVELS[protection.level]],
    ["Data", protection.data],
    ["Metadata", protection.metadata],
    ["RTPS messages", protection.rtps],
  ]);
  const unknown = el("p", { class: "soft", text: "It is not known: a policy does not state it." });
  parts.push(section("Protection", protection.level === "unknown" ? unknown : level));
  const others = bundle.names.filter((other) => other !== name);
  if (others.length) {
    const items = others.map((other) => el("li", {}, link(other, () => act.name(kind, other))));
    const list = el("details", {}, el("summary", { text: counted(others.length, "name") }), longList(items));
    parts.push(section("With the very same rights", list));
  }
  return parts;
}

// Equal enclaves on one card: each of them can be looked at.
export function equalDetails(card, act) {
  const items = card.members.map((path) => el("li", {}, link(path, () => act.enclave(path))));
  return [
    el("p", { class: "kind", text: `${counted(card.members.length, "enclave")} alike` }),
    el("h2", { text: card.lines.map((text) => text.trim()).join(""), tabindex: "-1" }),
    el("p", { class: "soft", text: "Their rights are equal except for their own names." }),
    section("Enclaves", longList(items)),
  ];
}

// Several names on one card: which of them is meant?
export function cardDetails(card, act) {
  const items = card.members.map((name) => el("li", {}, link(name, () => act.name(card.kind, name))));
  return [
    el("p", { class: "kind", text: `${counted(card.members.length, KINDS[card.kind])} alike` }),
    el("h2", { text: unwrapped(card.lines)[0], tabindex: "-1" }),
    section("Names", longList(items)),
  ];
}
