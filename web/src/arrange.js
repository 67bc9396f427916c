// Places parts of the picture that were asked for, by dagre's layered layout, and fits drawings that
// are wider than the window into it.

import dagre from "@dagrejs/dagre";
import { curveBumpX, curveBumpY, line } from "d3-shape";
import { KINDS, counted, sends } from "./words.js";

const SIZES = { letter: 7.4, smallLetter: 6.2, line: 16, small: 14, pad: 7 };
const WRAP = { enclave: 22, names: 35 };
const GAP = 90;
const MARGIN = 14;
export const MOST_BUNDLES = 160;
const MOST_NAMES = 8;
const SHOWN_NAMES = 4;

// Cuts names as the drawing on paper does: before a slash or after an underscore; within a word only
// if the word has more letters than the line.
function wrapped(text, letters) {
  const lines = [];
  while (text.length > letters) {
    const head = text.slice(0, letters);
    let cut = Math.max(head.lastIndexOf("/"), head.lastIndexOf("_"));
    if (cut <= head.search(/[^ ]/)) cut = letters - 1;
    else if (text[cut] === "_") cut += 1;
    lines.push(text.slice(0, cut));
    text = `  ${text.slice(cut)}`;
  }
  return [...lines, text];
}

// The names that lines of a card show, each as one text again.
export const unwrapped = (lines) => lines.join("\n").replace(/\n {2,}/g, "").split("\n");

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

function enclaveCard(id, path, notes = []) {
  const card = { id, role: "enclave", members: [path], lines: wrapped(path, WRAP.enclave), notes, tags: "" };
  return { ...card, width: widthOf(card, 24, 100), height: height(card) };
}

function namesCard(id, bundle) {
  const shown = bundle.names.slice(0, bundle.names.length > MOST_NAMES ? SHOWN_NAMES : MOST_NAMES);
  const rest = bundle.names.length - shown.length;
  const card = {
    id,
    role: "names",
    kind: bundle.kind,
    level: bundle.protection.level,
    members: bundle.names,
    lines: shown.flatMap((name) => wrapped(name, WRAP.names)),
    notes: [...(rest ? [`and ${rest} more ${KINDS[bundle.kind]}s`] : []), ...[bundle.open, bundle.lacks].filter(Boolean)],
    tags: "",
    lacks: bundle.lacks,
  };
  return { ...card, width: widthOf(card, 62, 130), height: height(card) };
}

// One link for all that an enclave may do with a bundle on one side of it.
function linkOf(source, target, bundle, ties) {
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
export function columns(bundles) {
  const cards = new Map();
  const links = [];
  bundles.slice(0, MOST_BUNDLES).forEach((bundle, number) => {
    const id = `n${number}`;
    cards.set(id, namesCard(id, bundle));
    const groups = new Map();
    for (const tie of bundle.ties) {
      const key = `${sends(tie) ? "s" : "l"}${tie.enclave} ${tie.deny} ${tie.mark}`;
      if (!groups.has(key)) groups.set(key, []);
      groups.get(key).push(tie);
    }
    for (const ties of groups.values()) {
      const side = `${sends(ties[0]) ? "s" : "l"}${ties[0].enclave}`;
      if (!cards.has(side)) cards.set(side, enclaveCard(side, ties[0].enclave));
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
  // Names that nobody sends stand in the column of the other names, not in that of the senders.
  const sent = new Set(links.map((link) => link.target));
  const sender = all.find((card) => card.id[0] === "s");
  const unsent = all.filter((card) => sender && card.role === "names" && !sent.has(card.id));
  const scene = arranged(all, links, unsent.map((card) => [sender.id, card.id]));
  return { ...scene, heads: heads(scene.cards) };
}

// What the three columns are, above them.
function heads(cards) {
  const headings = [];
  const add = (column, anchor, at, text) => {
    const card = cards.find(column);
    if (card) headings.push({ x: card.x + card.width * at, anchor, text });
  };
  add((card) => card.role !== "names" && card.id[0] === "s", "start", 0, "may send");
  add((card) => card.role === "names", "middle", 0.5, "topics, services, actions");
  add((card) => card.role !== "names" && card.id[0] === "l", "end", 1, "may receive");
  return headings;
}

// What flows to a name, or from it, so many hops far.  Names by which information goes between
// the very same enclaves stand on one card.
export function flowScene({ start, hops, steps }, upstream, most) {
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
    cards.push({ ...namesCard(id, bundle), chosen: key === "start" });
    for (const [side, before] of [[far, upstream], [near, !upstream]]) {
      for (const [path, ties] of side) {
        const pair = before ? [`e${path}`, id] : [id, `e${path}`];
        links.push(linkOf(...pair, bundle, ties));
      }
    }
  });
  const used = new Set(links.flatMap((link) => [link.source, link.target]));
  for (const [path, hop] of hops) {
    if (used.has(`e${path}`)) cards.push(enclaveCard(`e${path}`, path, [counted(hop, "hop")]));
  }
  return arranged(cards, links);
}

// Cards from left to right along the links; ``ahead`` has pairs of cards with nothing drawn between
// them, of which the first also stands further left.
function arranged(cards, links, ahead = []) {
  const graph = new dagre.graphlib.Graph({ multigraph: true });
  graph.setGraph({ rankdir: "LR", nodesep: 9, edgesep: 4, ranksep: GAP, marginx: MARGIN, marginy: 34 });
  graph.setDefaultEdgeLabel(() => ({}));
  for (const card of cards) graph.setNode(card.id, { width: card.width, height: card.height });
  links.forEach((link, number) => graph.setEdge(link.source, link.target, {}, `${number}`));
  for (const [left, right] of ahead) graph.setEdge(left, right, { weight: 0 }, "ahead");
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

// ── fitting ──────────────────────────────────────────────────────────────────────────────────

// Columns become as narrow as this, and no narrower: then the drawing is moved sideways.
const LEAST = { enclave: 100, names: 120 };
const NARROW_GAP = 26;
const SLIM = 200; // below this width of names, letters are small and the lock is below the symbol
const TOP = 46;
const LEAD = 24;

// The scene for a window of this width, with letters as large as before: narrower columns, whose
// texts take more lines.  Cards keep their order in their column.
export function fitted(scene, room) {
  if (scene.width <= room || !scene.cards.length) return scene;
  const columnsOf = byColumn(scene.cards);
  const widths = fittingWidths(columnsOf, room);
  if (columnsOf.length > 3 && sumOf(widths) + NARROW_GAP * (widths.length - 1) + 16 > room) return stacked(scene, columnsOf, room);
  const gap = Math.max(NARROW_GAP, Math.floor((room - 16) * 0.07));
  const slim = widths.some((width, at) => columnsOf[at][0].role === "names" && width < SLIM);
  const frameOf = (card) => scene.frames.find((frame) => contains(frame, card));
  let x = 8;
  const placed = columnsOf.map((cards, at) => {
    const left = x;
    x += widths[at] + gap;
    return cards.map((card) => ({ ...withRoomForTips(rewrapped(card, widths[at], slim), card), x: left, frame: frameOf(card) }));
  });
  settle(placed, scene.links);
  const cards = placed.flat();
  const box = new Map(cards.map((card) => [card.id, card]));
  const before = new Map(scene.cards.map((card) => [card.id, card]));
  const port = (id, y) => {
    const [old, now] = [before.get(id), box.get(id)];
    return now.y + (y === undefined ? now.height / 2 : ((y - old.y) / old.height) * now.height);
  };
  const links = scene.links.map(({ path, ...link }) => ({ ...link, y1: port(link.source, link.y1), y2: port(link.target, link.y2) }));
  const frames = scene.frames.map((frame) => around(frame, cards.filter((card) => card.frame === frame)));
  const width = x - gap + 8;
  const height = Math.max(...cards.map((card) => card.y + card.height)) + MARGIN;
  return { ...scene, width, height, slim, cards, links, frames, heads: fittedHeads(scene, before, box) };
}

// A flow of more columns than the window has room for goes from top to bottom: each column is a band
// with two cards next to each other, below what the column is.  A link passes other rows of a band
// between their cards, not behind them, where it would seem to be theirs.
function stacked(scene, columnsOf, room) {
  const cards = [];
  const bandHeads = [];
  let y = 0;
  for (const column of columnsOf) {
    const head = (scene.heads ?? []).find(({ x }) => column[0].x <= x && x <= column[0].x + column[0].width);
    if (head) bandHeads.push({ text: head.text, x: 8, y: y + 16, anchor: "start" });
    y += head ? 24 : 8;
    const width = Math.floor((room - 32) / 2);
    const top = y;
    const placed = [];
    let row = [];
    for (const old of column) {
      const frame = scene.frames.find((each) => contains(each, old));
      const isNew = frame !== row[0]?.frame;
      if (row.length && (isNew || row.length === 2)) {
        y = below(row);
        row = [];
      }
      if (isNew && frame) y += LEAD;
      const x = column.length === 1 ? Math.round((room - width) / 2) : 8 + row.length * (width + 16);
      row.push({ ...rewrapped(old, width, true), frame, x, y });
      placed.push(row.at(-1));
    }
    const [first, last] = [placed[0].y, row[0].y];
    y = below(row) + NARROW_GAP;
    for (const card of placed) cards.push({ ...card, enters: card.y > first ? top : 0, leaves: card.y < last ? y - NARROW_GAP : 0 });
  }
  const frames = scene.frames.map((frame) => ({ ...around(frame, cards.filter((card) => card.frame === frame)), x: 2, width: room - 4 }));
  const box = new Map(cards.map((card) => [card.id, card]));
  const down = line().curve(curveBumpY);
  const middle = room / 2;
  const links = scene.links.map((link) => {
    const [from, to] = [box.get(link.source), box.get(link.target)];
    const [start, end] = [from.y + from.height, to.y - 1];
    const out = from.leaves ? [[middle, start + 13], [middle, from.leaves]] : [];
    const into = to.enters ? [[middle, to.enters], [middle, end - 13]] : [];
    return { ...link, path: down([[from.x + from.width / 2, start], ...out, ...into, [to.x + to.width / 2, end]]) };
  });
  return { ...scene, width: room, height: y, slim: true, stacked: true, cards, links, frames, heads: bandHeads };
}

const below = (row) => Math.max(...row.map((card) => card.y + card.height)) + 14;

// Cards from left to right in columns, and in each column from the top.
function byColumn(cards) {
  const columnList = [];
  const middle = (card) => card.x + card.width / 2;
  for (const card of [...cards].sort((a, b) => middle(a) - middle(b))) {
    const last = columnList.at(-1);
    if (last && middle(card) - middle(last[0]) < 8) last.push(card);
    else columnList.push([card]);
  }
  for (const column of columnList) column.sort((a, b) => a.y - b.y);
  return columnList;
}

function fittingWidths(columnsOf, room) {
  const gap = Math.max(NARROW_GAP, Math.floor((room - 16) * 0.07));
  const natural = columnsOf.map((cards) => Math.max(...cards.map((card) => card.width)));
  const least = columnsOf.map((cards, at) => Math.min(natural[at], cards[0].role === "names" ? LEAST.names : LEAST.enclave));
  const spare = room - 16 - gap * (columnsOf.length - 1) - sumOf(least);
  const share = Math.min(1, Math.max(0, spare / Math.max(1, sumOf(natural) - sumOf(least))));
  return least.map((width, at) => Math.floor(width + (natural[at] - width) * share));
}

// The card with its texts in lines of this width.
function rewrapped(card, width, slim) {
  const names = card.role === "names";
  const letter = slim ? 6.8 : SIZES.letter;
  const around = (names ? (slim ? 30 : 62) : slim ? 14 : 24) + (names && slim ? 14 : 0) * card.tags.length;
  const lines = unwrapped(card.lines).flatMap((text) => wrapped(text, Math.floor((width - around) / letter)));
  const notes = card.notes.flatMap((text) => inWords(text, Math.floor((width - (names && slim ? 34 : 18)) / SIZES.smallLetter)));
  const fit = { ...card, width, slim, lines, notes };
  return { ...fit, height: Math.max(height(fit), names && slim && card.lock ? 46 : 0) };
}

// A card that many arrows lead to stays as high as the drawing on paper has it.
function withRoomForTips(card, before) {
  return before.height > height(before) ? { ...card, height: Math.max(card.height, before.height) } : card;
}

const sumOf = (numbers) => numbers.reduce((total, number) => total + number, 0);

function inWords(text, letters) {
  const lines = [""];
  for (const word of text.split(" ")) {
    const line = lines.at(-1);
    if (line && line.length + 1 + word.length > letters) lines.push(word);
    else lines[lines.length - 1] = line ? `${line} ${word}` : word;
  }
  return lines;
}

// Gives all cards their y: the tallest column has no gaps, and cards of the others come near the
// cards that they are linked with.
function settle(placed, links) {
  const near = new Map(placed.flat().map((card) => [card.id, []]));
  for (const { source, target } of links) {
    near.get(source).push(target);
    near.get(target).push(source);
  }
  const extent = (column) => column.reduce((sum, card) => sum + card.height + 9, 0);
  const tallest = placed.reduce((best, column, at) => (extent(column) > extent(placed[best]) ? at : best), 0);
  const order = placed.map((_, at) => at).sort((a, b) => Math.abs(a - tallest) - Math.abs(b - tallest));
  const middles = new Map();
  for (const at of order) {
    const wanted = (card) => {
      const ends = near.get(card.id).filter((end) => middles.has(end)).map((end) => middles.get(end));
      return ends.length ? ends.reduce((sum, end) => sum + end, 0) / ends.length : 0;
    };
    stack(placed[at], at === tallest ? () => 0 : wanted);
    for (const card of placed[at]) middles.set(card.id, card.y + card.height / 2);
  }
}

// As near to the wanted middles as the other cards of the column allow: pools of cards that touch
// move together (isotonic regression).
function stack(column, wanted) {
  let offset = 0;
  const offsets = column.map((card, at) => {
    if (card.frame && card.frame !== column[at - 1]?.frame) offset += LEAD;
    const own = offset;
    offset += card.height + 9;
    return own;
  });
  const pools = [];
  column.forEach((card, at) => {
    pools.push({ top: Math.max(TOP, wanted(card) - card.height / 2 - offsets[at]), count: 1 });
    while (pools.length > 1 && pools.at(-2).top > pools.at(-1).top) {
      const last = pools.pop();
      const pool = pools.at(-1);
      pool.top = (pool.top * pool.count + last.top * last.count) / (pool.count + last.count);
      pool.count += last.count;
    }
  });
  const tops = pools.flatMap(({ top, count }) => Array(count).fill(top));
  column.forEach((card, at) => {
    card.y = Math.round(tops[at] + offsets[at]);
  });
}

function contains(frame, card) {
  return frame.x <= card.x && card.x + card.width <= frame.x + frame.width && frame.y <= card.y && card.y <= frame.y + frame.height;
}

function around(frame, cards) {
  const [first, last] = [cards[0], cards.at(-1)];
  const letters = Math.floor((first.width + 4) / SIZES.smallLetter);
  const short = frame.title.length > letters ? frame.title.split(": ")[0] : frame.title;
  const title = short.length > letters ? `\u2026${short.slice(1 - letters)}` : short;
  const y = first.y - LEAD;
  return { title, x: first.x - 6, y, width: first.width + 12, height: last.y + last.height + 6 - y };
}

// A heading stays at the same part of the card below it, in words below each other.
function fittedHeads(scene, before, box) {
  return (scene.heads ?? []).map((head) => {
    const below = [...before.values()].find((card) => card.x <= head.x && head.x <= card.x + card.width);
    if (!below) return head;
    const now = box.get(below.id);
    const x = now.x + ((head.x - below.x) / below.width) * now.width;
    return { ...head, x, lines: inWords(head.text, Math.floor((now.width + (head.anchor === "middle" ? 20 : 8)) / 8)) };
  });
}
