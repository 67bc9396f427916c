// The words of the page that several of its parts say.

export { counted } from "./dom.js";
export { KINDS, LEVELS, sends } from "./model.js";

export const SENDS = { topics: "publish", dds: "publish", services: "call", actions: "call" };
export const RECEIVES = { topics: "subscribe", dds: "subscribe", services: "serve", actions: "execute" };

export const ONLOOKERS = {
  publish: "also published by",
  subscribe: "also subscribed by",
  request: "also called by",
  reply: "also served by",
  call: "also called by",
  execute: "also executed by",
};

export function markText(overlay, mark) {
  if (!overlay || mark === "both") return "";
  return mark === "first" ? overlay.first : overlay.second;
}

// Who may use only known names of a wildcard has rows of these names.
export function noneText({ names, lacks }, others, nobody = "nobody") {
  if (lacks || !names.some((name) => /[*?[]/.test(name))) return nobody;
  return others.length ? "other enclaves, for single names only" : nobody;
}
