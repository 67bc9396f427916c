// The expiry of certificates, permissions, CAs and revocation lists.

import { axisTop } from "d3-axis";
import { scaleUtc } from "d3-scale";
import { select } from "d3-selection";
import { counted, el, svg } from "./dom.js";

const DAY = 86400000;
const WIDTH = 520;

export const daysLeft = (validity) => Math.floor((Date.parse(validity.not_after) - Date.now()) / DAY);
export const dateText = (moment) => moment.slice(0, 10);

export function leftText(validity) {
  const days = daysLeft(validity);
  if (Date.parse(validity.not_before) > Date.now()) return "not valid yet";
  if (days < 0) return `expired ${counted(-days, "day")} ago`;
  return days === 0 ? "expires today" : `${counted(days, "day")} left`;
}

function state(validity) {
  const days = daysLeft(validity);
  if (days < 0 || Date.parse(validity.not_before) > Date.now()) return "error";
  return days < 30 ? "warning" : "good";
}

// What is valid for the same days is one row, which is as good as the worst of it: the first to
// expire, as they come, and the last to begin.
function rows(validities) {
  const groups = new Map();
  for (const validity of validities) {
    const days = [validity.not_before, validity.not_after].map(dateText);
    const key = [validity.kind, ...days, validity.enclave ? "" : validity.title].join(" ");
    if (!groups.has(key)) groups.set(key, { ...validity, members: [] });
    const group = groups.get(key);
    group.members.push(validity);
    if (validity.not_before > group.not_before) group.not_before = validity.not_before;
  }
  return [...groups.values()];
}

export function timeline(validities, onEnclave) {
  if (!validities.length) {
    return [el("p", { class: "soft", text: "No expiry is known: the picture shows policies, not a keystore." })];
  }
  const times = validities.flatMap((validity) => [Date.parse(validity.not_before), Date.parse(validity.not_after)]);
  // CAs expire years later than the rest; the scale must still separate what expires first.
  const leaves = validities.filter((validity) => validity.enclave).map((validity) => Date.parse(validity.not_after));
  const last = Math.max(Date.now(), ...(leaves.length ? leaves : times));
  const first = Math.min(Date.now(), ...times);
  const scale = scaleUtc([first, last + (last - first) * 0.08], [6, WIDTH - 6]).clamp(true);
  const axis = svg("svg", { viewBox: `0 0 ${WIDTH} 22`, class: "axis", "aria-hidden": "true" });
  select(axis).append("g").attr("transform", "translate(0 21)").call(axisTop(scale).ticks(6).tickSizeOuter(0));
  const head = ["What", "Expires", "Left"].map((text) => el("th", { scope: "col", text }));
  head.push(el("th", { scope: "col", class: "bars" }, el("span", { class: "hidden", text: "Time" }), axis));
  const body = rows(validities).map((validity) => row(validity, scale, onEnclave));
  return [
    el("p", { class: "soft" }, "The first to expire comes first. ", el("span", { class: "bars" }, "The line is today; a bar with an arrow continues beyond the chart.")),
    el("table", { class: "timeline" }, el("thead", {}, el("tr", {}, head)), el("tbody", {}, body)),
  ];
}

function row(validity, scale, onEnclave) {
  const [from, to, today] = [validity.not_before, validity.not_after, Date.now()].map((moment) => scale(new Date(moment)));
  const beyond = Date.parse(validity.not_after) > scale.domain()[1];
  const bar = svg(
    "svg",
    { viewBox: `0 0 ${WIDTH} 20`, preserveAspectRatio: "none", class: "bar", "aria-hidden": "true" },
    svg("rect", { class: `span ${state(validity)}`, x: from, y: 6, width: Math.max(2, to - from), height: 8, rx: 2 }),
    beyond ? svg("path", { class: `span ${state(validity)}`, d: `M${to - 2} 2l8 8l-8 8z` }) : null,
    svg("line", { class: "today", x1: today, x2: today, y1: 0, y2: 20 }),
  );
  const { kind, enclave, members } = validity;
  const names = members.map(({ title, enclave: path }) => el("button", { type: "button", class: "link-button", text: title, onclick: () => onEnclave(path) }));
  const folded = () => el("details", {}, el("summary", { text: `${kind} of ${members.length} enclaves` }), el("ul", { class: "plain" }, names.map((name) => el("li", {}, name))));
  const label = !enclave ? validity.title : members.length > 1 ? folded() : [`${kind} `, ...names];
  return el(
    "tr",
    {},
    el("th", { scope: "row" }, label),
    el("td", {}, el("time", { datetime: validity.not_after, text: dateText(validity.not_after) })),
    el("td", {}, el("span", { class: `chip ${state(validity)}`, text: leftText(validity) })),
    el("td", { class: "bars" }, bar),
  );
}
