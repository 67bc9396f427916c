// Places parts of the picture that were asked for, by dagre's layered layout.

import dagre from "@dagrejs/dagre";
import { curveBumpX, line } from "d3-shape";
import { KINDS, counted, sends } from "./words.js";

const SIZES = { letter: 7.4, smallLetter: 6.2, line: 16, small: 14, pad: 7 };
export const MOST_BUNDLES = 160;
const MOST_NAMES = 8;
const SHOWN_NAMES = 4;

// As the drawing on paper cuts names: after a slash or an underscore, where one is near.
export function wrapped(text, letters) {
  const lines = [];
  while (text.length > letters) {
    const head = text.slice(0, letters);
    let cut = Math.max(head.lastIndexOf("/"), head.slice(0, -1).lastIndexOf("_"));
    if (cut < letters / 2) cut = letters - 1;
    else if (text[cut] === "_") cut += 1;
    lines.push(text.slice(0, cut));
    text = `  ${text.slice(cut)}`;
  }
  return [...lines, text];
}

function height(card) {
  const { line: row, small, pad } = SIZES;
  return 2 * pad + row * card.lines.length + small * card.notes.length;
}

function widthOf(card, around, least) {
  const { letter, smallLetter } = SIZES;
  const longest = (texts) => Math.max(0, ...texts.map((text) => text.length));
  const lock = card.role === "names" ? 18 : 0; // it stands next to the names, not next to the notes
  const room = Math.max(longest(card.lines) * letter, longest(card.notes) * smallLetter - lock);
  return Math.max(least, Math.round(room + around));
}

// In a narrow drawing, three columns fit a phone.
const WIDE = { enclave: 22, around: 24, name: 35, gap: 90, margin: 14 };
const NARROW = { enclave: 15, around: 18, name: 14, gap: 26, margin: 8 };
const sized = (narrow) => (narrow ? NARROW : WIDE);

export function enclaveCard(id, path, notes = [], narrow = false) {
  const card = { id, role: "enclave", members: [path], lines: wrapped(path, sized(narrow).enclave), notes, tags: "" };
  return { ...card, width: widthOf(card, sized(narrow).around, 100), height: height(card) };
}

export function namesCard(id, bundle, narrow = false) {
  const shown = bundle.names.slice(0, bundle.names.length > MOST_NAMES ? SHOWN_NAMES : MOST_NAMES);
  const rest = bundle.names.length - shown.length;
  const card = {
    id,
    role: "names",
    kind: bundle.kind,
    level: bundle.protection.level,
    members: bundle.names,
    lines: shown.flatMap((name) => wrapped(name, sized(narrow).name)),
    notes: [...(rest ? [`and ${rest} more ${KINDS[bundle.kind]}s`] : []), ...[bundle.open, bundle.lacks].filter(Boolean)],
    tags: "",
    lacks: bundle.lacks,
  };
  return { ...card, width: widthOf(card, 62, 130), height: height(card) };
}

// One link for all that an enclave may do with a bundle on one side of it.
export function linkOf(source, target, bundle, ties) {
  return {
    source,
    target,
    rights: [...new Set(ties.map((tie) => tie.right))].sort(),
    deny: ties.some((tie) => tie.deny),
    level: bundle.protection.level,
    wildcard: ties.every((tie) => tie.by.length > 0),
    open: ties.every((tie) => tie.open),
    violates: ties.some((tie) => tie.violates),
    mark: ties[0].mark,
  };
}

// The names that fit a filter: senders on the left, listeners on the right.
export function columns(bundles, narrow = false) {
  const cards = new Map();
  const links = [];
  bundles.slice(0, MOST_BUNDLES).forEach((bundle, number) => {
    const id = `n${number}`;
    cards.set(id, namesCard(id, bundle, narrow));
    const groups = new Map();
    for (const tie of bundle.ties) {
      const key = `${sends(tie) ? "s" : "l"}${tie.enclave} ${tie.deny} ${tie.mark}`;
      if (!groups.has(key)) groups.set(key, []);
      groups.get(key).push(tie);
    }
    for (const ties of groups.values()) {
      const side = `${sends(ties[0]) ? "s" : "l"}${ties[0].enclave}`;
      if (!cards.has(side)) cards.set(side, enclaveCard(side, ties[0].enclave, [], narrow));
      const ends = sends(ties[0]) ? [side, id] : [id, side];
      links.push(linkOf(...ends, bundle, ties));
    }
  });
  // All as wide as the widest, so that the columns have straight edges.
  const all = [...cards.values()];
  for (const names of [true, false]) {
    const column = all.filter((card) => (card.role === "names") === names);
    const width = Math.max(0, ...column.map((card) => card.width));
    for (const card of column) card.width = width;
  }
  const scene = arranged(all, links, narrow);
  return { ...scene, heads: heads(scene.cards) };
}

// What the columns are, above them; only where every card is in one of the three.
function heads(cards) {
  const found = [];
  const add = (column, anchor, at, text) => {
    const card = cards.find(column);
    if (card) found.push({ x: card.x + card.width * at, anchor, text });
  };
  add((card) => card.role !== "names" && card.id[0] === "s", "start", 0, "may send");
  add((card) => card.role === "names", "middle", 0.5, "topics, services, actions");
  add((card) => card.role !== "names" && card.id[0] === "l", "end", 1, "may receive");
  return found;
}

// What flows to a name, or from it, so many hops far.  Names by which information goes between
// the very same enclaves stand on one card.
export function flowScene({ start, hops, steps }, upstream, most, narrow = false) {
  const ends = new Map();
  for (const { hop, bundle, tie, near } of steps) {
    if (hop > most || (!near && hop === most)) continue;
    if (!ends.has(bundle)) ends.set(bundle, { near: new Map(), far: new Map() });
    // Near is where the flow comes from, seen from the name that was asked for.
    const side = ends.get(bundle)[near ? "far" : "near"];
    if (!side.has(tie.enclave)) side.set(tie.enclave, []);
    side.get(tie.enclave).push(tie);
  }
  const merged = new Map();
  for (const [bundle, { near, far }] of ends) {
    if (bundle !== start && !far.size) continue; // nobody uses it on its far side
    const kind = [bundle.kind, bundle.protection.level];
    const key = bundle === start ? "start" : JSON.stringify([kind, [...near.keys()].sort(), [...far.keys()].sort()]);
    if (!merged.has(key)) merged.set(key, { bundle: { ...bundle, names: [] }, near, far });
    merged.get(key).bundle.names.push(...bundle.names);
  }
  if (!merged.has("start")) merged.set("start", { bundle: start, near: new Map(), far: new Map() });
  const cards = [];
  const links = [];
  [...merged].forEach(([key, { bundle, near, far }], number) => {
    const id = `n${number}`;
    cards.push({ ...namesCard(id, bundle, narrow), chosen: key === "start" });
    for (const [side, before] of [[far, upstream], [near, !upstream]]) {
      for (const [path, ties] of side) {
        const pair = before ? [`e${path}`, id] : [id, `e${path}`];
        links.push(linkOf(...pair, bundle, ties));
      }
    }
  });
  const used = new Set(links.flatMap((link) => [link.source, link.target]));
  for (const [path, hop] of hops) {
    if (used.has(`e${path}`)) cards.push(enclaveCard(`e${path}`, path, [counted(hop, "hop")], narrow));
  }
  return arranged(cards, links, narrow);
}

function arranged(cards, links, narrow) {
  const { gap, margin } = sized(narrow);
  const graph = new dagre.graphlib.Graph({ multigraph: true });
  graph.setGraph({ rankdir: "LR", nodesep: 9, edgesep: 4, ranksep: gap, marginx: margin, marginy: 34 });
  graph.setDefaultEdgeLabel(() => ({}));
  for (const card of cards) graph.setNode(card.id, { width: card.width, height: card.height });
  links.forEach((link, number) => graph.setEdge(link.source, link.target, {}, `${number}`));
  dagre.layout(graph);
  const path = line().curve(curveBumpX).x((point) => point.x).y((point) => point.y);
  const placed = cards.map((card) => {
    const { x, y } = graph.node(card.id);
    return { ...card, x: Math.round(x - card.width / 2), y: Math.round(y - card.height / 2) };
  });
  const box = new Map(placed.map((card) => [card.id, card]));
  const drawn = links.map((link, number) => {
    const { points } = graph.edge(link.source, link.target, `${number}`);
    const ends = [points[0], ...points.slice(1, -1).filter((_, n) => n % 2), points.at(-1)];
    const from = box.get(link.source);
    const to = box.get(link.target);
    const inner = points.length > 3 ? ends.slice(1, -1) : [];
    return {
      ...link,
      path: path([
        { x: from.x + from.width, y: from.y + from.height / 2 },
        ...inner,
        { x: to.x - 1, y: to.y + to.height / 2 },
      ]),
    };
  });
  const { width = 200, height: tall = 100 } = graph.graph();
  return {
    width: Math.ceil(width),
    height: Math.ceil(tall),
    cards: placed,
    links: drawn,
    frames: [],
    onlookers: [],
  };
}
