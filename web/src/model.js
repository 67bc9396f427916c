// The picture as it was written into the page, with the questions that are put to it.

export const KINDS = { topics: "topic", services: "service", actions: "action", dds: "DDS topic" };
export const LEVELS = {
  encrypt: "encrypted",
  sign: "signed, readable",
  none: "not protected",
  unknown: "protection unknown",
};
const SENDS = new Set(["publish", "request", "call"]);
const ONE_WAY = new Set(["publish", "subscribe"]);

export const sends = (tie) => SENDS.has(tie.right);

export class Model {
  #sides = new Map();
  #parts;

  constructor(data) {
    Object.assign(this, data);
    this.#parts = partsOfDomains(data.enclaves);
    this.bundles = data.bundles.map(([names, traits, ties]) => ({
      ...data.traits[traits],
      names,
      ties: ties.flatMap(([kind, ...numbers]) => numbers.map((number) => ({ ...data.ties[kind], enclave: data.enclaves[number].path }))),
    }));
    for (const scene of data.scenes) {
      scene.cards = rowsOf(scene.cards);
      scene.links = rowsOf(scene.links);
    }
    if (data.has_least_levels) LEVELS.sign = "at least signed";
    this.enclave = new Map(data.enclaves.map((enclave) => [enclave.path, enclave]));
    this.bundleOf = new Map();
    this.tiesOf = new Map(data.enclaves.map((enclave) => [enclave.path, []]));
    for (const bundle of this.bundles) {
      for (const name of bundle.names) this.bundleOf.set(`${bundle.kind} ${name}`, bundle);
      for (const tie of bundle.ties) this.tiesOf.get(tie.enclave).push({ tie, bundle });
    }
    this.names = this.bundles.flatMap((bundle) =>
      bundle.names.map((name) => ({
        kind: bundle.kind,
        name,
        common: bundle.ties.every((tie) => tie.common),
      })),
    );
    this.names.sort((a, b) => (a.name < b.name ? -1 : a.name > b.name ? 1 : 0));
    this.namespaces = [...new Set(this.names.flatMap(({ name }) => prefixes(name)))].sort();
  }

  // Why a page with a focus lacks rights that the enclaves on it have; "" for other pages.
  get extract() {
    return this.scenes[0].id === "focus" ? `This page has only rights that lead to or from ${this.scenes[0].title}; without --focus, the page has all rights.` : "";
  }

  bundle(kind, name) {
    return this.bundleOf.get(`${kind} ${name}`);
  }

  // What a person types, as enclaves and names that hold it, the nearest first; names that only
  // every node needs come last.
  search(text, most) {
    const wanted = text.trim().toLowerCase();
    if (!wanted) return { enclaves: [], names: [], more: 0 };
    const nearest = (list, nameOf) =>
      list
        .map((item) => [nearness(nameOf(item).toLowerCase(), wanted) + (item.common ? 9 : 0), item])
        .filter(([rank]) => rank < 99)
        .sort((a, b) => a[0] - b[0])
        .map(([, item]) => item);
    const enclaves = nearest(this.enclaves, (item) => item.path);
    const names = nearest(this.names, (item) => item.name);
    const more = Math.max(0, enclaves.length - most) + Math.max(0, names.length - most);
    return { enclaves: enclaves.slice(0, most), names: names.slice(0, most), more };
  }

  validitiesOf(path) {
    return this.validities.filter((validity) => validity.enclave === path);
  }

  findingsOf(path) {
    return this.findings.filter((finding) => finding.enclave === path);
  }

  // The bundles that fit the filters, with the ties of them that do.
  filtered({ enclave, namespace, direction, protection, mark, common }) {
    const fitting = [];
    for (const bundle of this.bundles) {
      if (protection && bundle.protection.level !== protection) continue;
      let names = bundle.names;
      if (namespace) names = names.filter((name) => prefixes(name).includes(namespace));
      if (!names.length) continue;
      let ties = common ? bundle.ties : bundle.ties.filter((tie) => !tie.common);
      if (mark) ties = ties.filter((tie) => (mark === "deny" ? tie.deny : tie.mark === mark));
      if (direction === "deny") ties = ties.filter((tie) => tie.deny);
      const own = enclave ? ties.filter((tie) => tie.enclave === enclave) : ties;
      if (direction && direction !== "deny") {
        const fits = own.filter((tie) => sends(tie) === (direction === "send"));
        if (!fits.length) continue;
        if (!enclave) ties = fits;
        else ties = ties.filter((tie) => tie.enclave !== enclave || fits.includes(tie));
      } else if (!own.length) continue;
      if (ties.length) fitting.push({ ...bundle, names, ties });
    }
    return fitting;
  }

  // Who writes (or reads) a bundle in the sense of information that flows: whom permissions allow
  // it, denials left out, and everybody else where the governance does not look at permissions.
  #ends(bundle, writing) {
    // With a topic that every node writes and reads, everybody would reach everybody.
    if (bundle.names.every((name) => this.of_every_node.includes(name))) return [];
    // A request that only asks tells the server nothing.
    const silent = bundle.asks ? (writing ? "request" : "reply") : "";
    const ties = bundle.ties.filter(
      (tie) => !tie.deny && tie.right !== silent && (!ONE_WAY.has(tie.right) || sends(tie) === writing),
    );
    const { read_control, write_control } = bundle.protection;
    if (writing ? write_control : read_control) return ties;
    const right = writing ? "publish" : "subscribe";
    const said = new Set(ties.map((tie) => tie.enclave));
    for (const { path } of this.enclaves) {
      if (!said.has(path)) ties.push({ enclave: path, right, open: true, by: [], parts: [], mark: "both" });
    }
    return ties;
  }

  // The parts of the ROS domains in which an enclave is, for one of its rights: with a name that is
  // open to everybody, it is in every domain that it can join.
  #partsOf({ enclave, open }) {
    return open && !this.join_needs_right ? this.#parts.all : this.#parts.of.get(enclave);
  }

  // All ends of one direction: of each bundle in each part of the domains, and with their bundles
  // of each enclave.
  #side(writing) {
    if (!this.#sides.has(writing)) {
      const of = new Map(this.bundles.map((bundle) => [bundle, new Map()]));
      const by = new Map(this.enclaves.map(({ path }) => [path, []]));
      for (const [bundle, inPart] of of) {
        for (const tie of this.#ends(bundle, writing)) {
          by.get(tie.enclave).push({ tie, bundle });
          for (const part of this.#partsOf(tie)) {
            if (!inPart.has(part)) inPart.set(part, []);
            inPart.get(part).push(tie);
          }
        }
      }
      this.#sides.set(writing, { of, by });
    }
    return this.#sides.get(writing);
  }

  // Where information comes from that reaches a name (or where it goes from there).  Steps lead
  // from enclaves to names and on; each enclave has the number of hops at which it is first met.
  // A service or an action carries both ways: requests there, replies back.  Information stays in
  // its ROS domain, so a bundle is met in each part of the domains by itself.
  flow(kind, name, upstream) {
    const start = this.bundle(kind, name);
    const [near, far] = [this.#side(upstream), this.#side(!upstream)];
    const hops = new Map();
    const steps = [];
    const taken = { true: new Set(), false: new Set() };
    const step = (hop, bundle, tie, isNear) => {
      if (taken[isNear].has(tie)) return;
      taken[isNear].add(tie);
      steps.push({ hop, bundle, tie, near: isNear });
    };
    const met = new Map(this.#parts.all.map((part) => [part, new Set()]));
    const meet = (bundle, part) => !met.get(part).has(bundle) && met.get(part).add(bundle);
    let front = this.#parts.all.filter((part) => meet(start, part)).map((part) => [start, part]);
    for (let hop = 1; front.length; hop += 1) {
      const reached = new Set();
      for (const [bundle, part] of front) {
        const others = far.of.get(bundle).get(part) ?? [];
        for (const tie of near.of.get(bundle).get(part) ?? []) {
          // What only the enclave itself sends, or receives, is no flow to it.
          if (hop === 1 && others.length && others.every((other) => other.enclave === tie.enclave)) continue;
          if (!hops.has(tie.enclave)) {
            hops.set(tie.enclave, hop);
            reached.add(tie.enclave);
          }
          if (hops.get(tie.enclave) === hop) step(hop, bundle, tie, true);
        }
      }
      front = [];
      for (const path of reached) {
        for (const { tie, bundle } of far.by.get(path)) {
          const parts = this.#partsOf(tie).filter((part) => !met.get(part).has(bundle));
          if (!parts.length) continue;
          step(hop, bundle, tie, false);
          for (const part of parts) front.push([bundle, part]);
        }
      }
      front = front.filter(([bundle, part]) => meet(bundle, part));
    }
    return { start, hops, steps };
  }
}

// The ROS domains of all enclaves, divided so that each enclave is in a part as a whole or not at
// all.  An enclave whose domains are not known is in every part.
function partsOfDomains(enclaves) {
  const ranges = new Map(
    enclaves.map(({ path, domains }) => [
      path,
      (domains || "").split(",").filter(Boolean).map((range) => {
        const [first, last = first] = range.split("-").map(Number);
        return [first, last];
      }),
    ]),
  );
  const edges = new Set([...ranges.values()].flat().flatMap(([first, last]) => [first, last + 1]));
  const firsts = [...edges].sort((a, b) => a - b);
  const all = firsts.length ? firsts.map((_, part) => part) : [0];
  const of = new Map();
  for (const [path, own] of ranges) {
    const isIn = (part) => own.some(([first, last]) => first <= firsts[part] && firsts[part] <= last);
    of.set(path, own.length ? all.filter(isIn) : all);
  }
  return { all, of };
}

// A table as it stands in the page: first the keys, then the values of each row.
function rowsOf([keys = [], ...rows]) {
  return rows.map((row) => Object.fromEntries(keys.map((key, at) => [key, row[at]])));
}

function nearness(name, wanted) {
  if (name === wanted || name === `/${wanted}`) return 0;
  if (!name.includes(wanted)) return 99;
  if (name.startsWith(wanted) || name.startsWith(`/${wanted}`)) return 1;
  if (name.slice(name.lastIndexOf("/") + 1).startsWith(wanted)) return 2;
  return name.includes(`/${wanted}`) ? 3 : 4;
}

function prefixes(name) {
  const parts = name.split("/").slice(0, -1);
  const namespaces = ["/"];
  for (let length = 2; length <= parts.length; length += 1) {
    namespaces.push(parts.slice(0, length).join("/"));
  }
  return namespaces;
}

// Ties with their bundles by what they allow or deny, such as "publish" and "DENY subscribe".
export function byRight(ties) {
  const groups = new Map();
  for (const entry of ties) {
    const key = `${entry.tie.deny ? "DENY " : ""}${entry.tie.right}`;
    if (!groups.has(key)) groups.set(key, []);
    groups.get(key).push(entry);
  }
  return groups;
}
