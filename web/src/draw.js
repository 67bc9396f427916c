// Draws a scene, whoever placed it: cards, links and frames, by d3; the keyboard moves among cards.

import { select } from "d3-selection";
import { linkHorizontal } from "d3-shape";
import { KINDS, LEVELS, ONLOOKERS, markText } from "./words.js";

const GLYPHS = {
  topics: "M1 2.5h11M1 6.5h11M1 10.5h7",
  services: "M1 4h10.5l-3-3M12 9H1.5l3 3",
  actions: "M6.5 1a5.5 5.5 0 1 0 .01 0zM6.5 4.5a2 2 0 1 0 .01 0z",
  dds: "M6.5 1L12 6.5L6.5 12L1 6.5z",
};
const LOCKS = {
  encrypt: "M2 6h9v6.5H2zM4 6V3.8a2.5 2.5 0 0 1 5 0V6M6.5 8.3v2",
  sign: "M1.5 12h10M2.5 9.5l1-2.6L9.3 1.2l1.8 1.8L5.2 8.7z",
  none: "M2 6h9v6.5H2zM4 6V3.8a2.5 2.5 0 0 1 4.8-1",
};

// A lock stands on each name, unless all names have the same.
export function withLocks(scene) {
  const levels = new Set(scene.cards.filter((card) => card.role === "names").map((card) => card.level));
  const lockOf = (card) => (levels.size > 1 && LOCKS[card.level] ? card.level : "");
  const same = levels.size === 1 ? [...levels][0] : "";
  return { ...scene, same, cards: scene.cards.map((card) => ({ ...card, lock: lockOf(card) })) };
}

const TIPS = [
  ["to", "tip", "M0 0.5L8 4L0 7.5z", 8, 7, "auto"],
  ["to1", "tip1", "M1 1L7 4L1 7z", 8, 7, "auto"],
  ["to2", "tip2", "M0 4L4 0L8 4L4 8z", 8, 7, "auto"],
  ["bad", "tipbad", "M0 0.5L8 4L0 7.5z", 8, 7, "auto"],
  ["odd", "tipodd", "M0 0.5L8 4L0 7.5z", 8, 7, "auto"],
  ["no", "cross", "M7 1.5a5.5 5.5 0 1 0 .01 0zM3.2 10.8L10.8 3.2", 14, 13, "0"],
];
const horizontal = linkHorizontal().x((point) => point[0]).y((point) => point[1]);

export function pathOf(link, cards) {
  if (link.path) return link.path;
  const from = cards.get(link.source);
  const to = cards.get(link.target);
  return horizontal({ source: [from.x + from.width, link.y1], target: [to.x - 1, link.y2] });
}

export function linkText(link, overlay) {
  const said = `${link.deny ? "DENY" : "ALLOW"} ${link.rights.join(", ")}`;
  const marked = markText(overlay, link.mark);
  return [said, link.wildcard && "by a wildcard", link.open && "as everybody may", link.violates && "breaks a requirement", link.differs && "the robots (namespaces, enclaves) that are drawn as one do not have this right", marked, LEVELS[link.level]]
    .filter(Boolean)
    .join(", ");
}

// What a card is called: what it is, what stands on it, and all that it stands for.
function cardText(card, problems) {
  const what = card.role === "names" ? KINDS[card.kind] : card.role;
  const texts = [...card.lines, ...card.notes].map((text) => text.trim());
  const marks = [...[...card.tags].reverse(), ...(problems ? ["!"] : [])];
  const level = card.role === "names" ? LEVELS[card.level] : problems ? "has problems" : "";
  const more = card.members.length > 3 ? "and more" : "";
  return [what, ...texts, ...marks, level, ...card.members.slice(0, 3), more].filter(Boolean).join(" ");
}

// `choose(card)` is called for a card that was clicked, or chosen by Enter or the space bar.
export function drawScene(node, scene, { overlay, problems, choose }) {
  const root = select(node);
  root.selectAll("*").remove();
  root
    .attr("viewBox", `0 0 ${scene.width} ${scene.height}`)
    .classed("dense", scene.links.length > 200)
    .classed("slim", Boolean(scene.slim))
    .attr("role", "group")
    .attr("aria-label", "Map of who may do what");
  root
    .append("defs")
    .selectAll("marker")
    .data(TIPS)
    .join("marker")
    .attr("id", (tip) => tip[0])
    .attr("viewBox", (tip) => `0 0 ${tip[3]} ${tip[3]}`)
    .attr("refX", (tip) => tip[4])
    .attr("refY", (tip) => tip[3] / 2)
    .attr("markerWidth", (tip) => tip[3])
    .attr("markerHeight", (tip) => tip[3])
    .attr("markerUnits", "userSpaceOnUse")
    .attr("orient", (tip) => tip[5])
    .append("path")
    .attr("class", (tip) => tip[1])
    .attr("d", (tip) => tip[2]);
  const frames = root.append("g").selectAll("g").data(scene.frames).join("g");
  frames
    .append("rect")
    .attr("class", "frame")
    .attr("x", (frame) => frame.x)
    .attr("y", (frame) => frame.y)
    .attr("width", (frame) => frame.width)
    .attr("height", (frame) => frame.height)
    .attr("rx", 8);
  frames
    .append("text")
    .attr("class", "small")
    .attr("x", (frame) => frame.x + 8)
    .attr("y", (frame) => frame.y + 16)
    .text((frame) => frame.title);
  root
    .append("g")
    .selectAll("text")
    .data(scene.heads ?? [])
    .join("text")
    .attr("class", "head")
    .attr("x", (head) => head.x)
    .attr("y", (head) => head.y ?? 16)
    .attr("text-anchor", (head) => head.anchor)
    .selectAll("tspan")
    .data((head) => (head.lines ?? [head.text]).map((text, at, all) => ({ text: at < all.length - 1 ? `${text} ` : text, x: head.x })))
    .join("tspan")
    .attr("x", (line) => line.x)
    .attr("dy", (_, at) => (at ? 13 : 0))
    .text((line) => line.text.toUpperCase());
  const cards = new Map(scene.cards.map((card) => [card.id, card]));
  const rank = (link) => (link.violates ? 5 : link.deny ? 4 : link.differs ? 3 : { both: 0, first: 1, second: 2 }[link.mark]);
  const links = root
    .append("g")
    .selectAll("path")
    .data([...scene.links].sort((a, b) => rank(a) - rank(b)))
    .join("path")
    .attr("class", (link) =>
      ["link", link.level, link.wildcard && "wild", link.mark !== "both" && link.mark, link.differs && "differs", link.violates && "violates", link.deny && "deny"]
        .filter(Boolean)
        .join(" "),
    )
    .attr("d", (link) => pathOf(link, cards));
  links.append("title").text((link) => linkText(link, overlay));
  const drawn = root
    .append("g")
    .selectAll("g")
    .data(scene.cards)
    .join("g")
    .attr("class", (card) => `card ${card.role}${card.chosen ? " chosen" : ""}${card.lacks ? " lacking" : ""}`)
    .attr("transform", (card) => `translate(${card.x} ${card.y})`)
    .attr("role", "button")
    .attr("tabindex", (_, number) => (number ? -1 : 0))
    .attr("aria-label", (card) => cardText(card, problems(card)))
    .on("click", (_, card) => choose(card))
    .on("keydown", (event, card) => moved(event, card, drawn, scene, choose))
    .each(function draw(card) {
      drawCard(select(this), card, problems(card));
    });
  return {
    // Cards and links that have to do with what `belongs` says are shown, the others fade.
    highlight(belongs) {
      const near = new Set();
      const lit = (link) => belongs(cards.get(link.source)) || belongs(cards.get(link.target));
      const any = belongs && scene.cards.some(belongs);
      if (any) {
        for (const link of scene.links.filter(lit)) near.add(link.source).add(link.target);
        for (const card of scene.cards.filter(belongs)) near.add(card.id);
        // An onlooker has no links: its tag stands on the names that it may read.
        for (const onlooker of scene.onlookers) {
          const looking = scene.cards.filter((card) => onlooks(card, onlooker));
          const watched = scene.cards.filter((card) => card.tags.includes(onlooker.tag));
          if (looking.some(belongs)) for (const card of watched) near.add(card.id);
          if (watched.some(belongs)) for (const card of looking) near.add(card.id);
        }
      }
      drawn.classed("faded", (card) => any && !near.has(card.id));
      drawn.classed("lit", (card) => any && belongs(card));
      links.classed("faded", (link) => any && !lit(link));
      return any;
    },
    card: (belongs) => drawn.filter(belongs).node(),
    // The card that an earlier drawing had as this element.
    again(node) {
      const before = select(node).datum();
      const same = drawn.filter((card) => card.id === before?.id).node();
      if (same) drawn.attr("tabindex", (card) => (card.id === before.id ? 0 : -1));
      return same;
    },
  };
}

function onlooks(card, onlooker) {
  return card.role !== "names" && card.id.slice(1) === onlooker.enclave;
}

function drawCard(group, card, problems) {
  group
    .append("rect")
    .attr("width", card.width)
    .attr("height", card.height)
    .attr("rx", 6);
  const names = card.role === "names";
  if (names) {
    group
      .append("path")
      .attr("class", "glyph")
      .attr("transform", card.slim ? "translate(7 9)" : "translate(10 9)")
      .attr("d", GLYPHS[card.kind]);
    if (card.lock) {
      group
        .append("path")
        .attr("class", `lock lock-${card.lock}`)
        .attr("transform", card.slim ? "translate(7 26)" : `translate(${card.width - 23} 8)`)
        .attr("d", LOCKS[card.lock]);
    }
  }
  const left = card.slim ? (names ? 26 : 8) : names ? 32 : 12;
  let y = 19;
  for (const text of card.lines) {
    group.append("text").attr("x", left).attr("y", y).text(`${text} `);
    y += 16;
  }
  let kind = "small";
  for (const text of card.notes) {
    // Its note stands last, perhaps in several lines.
    if (names && /^(nobody|everybody) may\b/.test(text)) kind = "small lack";
    group.append("text").attr("class", kind).attr("x", left).attr("y", y - 1).text(`${text} `);
    y += 14;
  }
  [...card.tags].reverse().forEach((tag, number) => {
    const x = card.width - (card.slim ? 6 + 13 * number : (card.lock ? 32 : 12) + 18 * number);
    group.append("text").attr("class", "tag").attr("x", x).attr("y", 19).attr("text-anchor", "end").text(`${tag} `);
  });
  if (problems) {
    const [x, at] = card.slim ? [card.width - 4, 2] : [card.width - 14, 14];
    group.append("circle").attr("class", "alarm").attr("cx", x).attr("cy", at).attr("r", 7);
    group.append("text").attr("class", "alarm-text").attr("x", x).attr("y", at + 4).attr("text-anchor", "middle").text("!");
  }
}

// The arrow keys lead to the next card in their direction, sideways to one that is linked if there
// is one; only one card is in the tab order.
function moved(event, card, drawn, { links, stacked }, choose) {
  if (event.key === "Enter" || event.key === " ") {
    event.preventDefault();
    choose(card);
    return;
  }
  const way = { ArrowDown: [0, 1], ArrowUp: [0, -1], ArrowRight: [1, 0], ArrowLeft: [-1, 0] }[event.key];
  if (!way) return;
  event.preventDefault();
  const centre = (box) => [box.x + box.width / 2, box.y + box.height / 2];
  const [x, y] = centre(card);
  const linked = new Set(links.flatMap(({ source, target }) => (source === card.id ? [target] : target === card.id ? [source] : [])));
  let best = null;
  drawn.each(function look(other) {
    const [toX, toY] = centre(other);
    const ahead = (toX - x) * way[0] + (toY - y) * way[1];
    const aside = Math.abs((toX - x) * way[1]) + Math.abs((toY - y) * way[0]);
    // Sideways a column is far; upwards and downwards one stays in it.
    if (ahead <= 20 || (way[1] && aside > 60 && !stacked)) return;
    const distance = way[0] ? ahead * 0.2 + aside + (linked.has(other.id) ? 0 : 1e6) : ahead + aside;
    if (!best || distance < best.distance) best = { distance, node: this };
  });
  if (best) {
    drawn.attr("tabindex", -1);
    best.node.setAttribute("tabindex", 0);
    best.node.focus();
    best.node.scrollIntoView({ block: "nearest", inline: "nearest" });
  }
}

export const onlookerText = ({ right, enclave }) => `${ONLOOKERS[right]} ${enclave.replace(/^:/, "")}`;

// What the symbols of this scene mean, as items of a list.
export function legend(scene, overlay, equal, make) {
  const items = [];
  const icon = (path, kind, wide) =>
    make.svg("svg", { class: "icon", width: wide ? 46 : 15, height: 15, "aria-hidden": "true" }, make.svg("path", { class: kind, d: path, transform: "translate(1 1)" }));
  const add = (drawing, text) => items.push(make.el("li", {}, drawing, make.el("span", { text })));
  for (const kind of Object.keys(GLYPHS)) {
    if (scene.cards.some((card) => card.kind === kind)) add(icon(GLYPHS[kind], "glyph"), KINDS[kind]);
  }
  for (const level of Object.keys(LOCKS)) {
    if (scene.cards.some((card) => card.level === level)) {
      if (scene.cards.some((card) => card.lock)) add(icon(LOCKS[level], `lock lock-${level}`), LEVELS[level]);
      if (level !== "encrypt") add(icon("M0 6h42", `link ${level}`, true), LEVELS[level]);
    }
  }
  const line = (kind, text) => add(icon("M0 6h42", `link ${kind}`, true), text);
  const allowed = scene.links.filter((link) => !link.deny);
  if (allowed.length) line("", "allowed");
  if (allowed.some((link) => link.wildcard)) line("wild", "by a wildcard only");
  if (scene.links.some((link) => link.deny)) line("deny", "denied");
  if (scene.links.some((link) => link.violates)) line("violates", "breaks a requirement");
  if (scene.links.some((link) => link.differs)) line("differs", "the robots (namespaces, enclaves) that are drawn as one do not have this right");
  const box = (kind, text) => add(icon("M1 1h40v12h-40z", `box ${kind}`, true), text);
  if (scene.cards.some((card) => card.chosen)) box("chosen", "in focus");
  if (scene.cards.some((card) => card.lacks)) box("lacking", "nobody may send it, or nobody may receive it");
  if (overlay && scene.links.some((link) => link.mark === "first")) line("first", overlay.first);
  if (overlay && scene.links.some((link) => link.mark === "second")) line("second", overlay.second);
  for (const units of equal) {
    if (!scene.cards.some((card) => [...card.lines, card.group ?? ""].some((text) => text.includes(units.label)))) continue;
    const text = `${units.label}: each of ${units.members.length} ${units.what}s, which are equal except for their names`;
    items.push(make.el("li", {}, make.el("span", { class: "label", text })));
  }
  if (scene.cards.some((card) => card.lines.some((text) => /{\d+ others? of /.test(text)))) {
    items.push(make.el("li", {}, make.el("span", { text: "{1 other of …}: such a name of another one of them" })));
  }
  if (scene.cards.some((card) => card.notes.some((text) => text.startsWith("own:")))) {
    items.push(make.el("li", {}, make.el("span", { text: "own: names that no other enclave may use" })));
  }
  return items;
}
