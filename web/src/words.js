// The words of the page that several of its parts say.

export { counted } from "./dom.js";
export { KINDS, LEVELS, sends } from "./model.js";

export const ONLOOKERS = {
  publish: "also written by",
  subscribe: "also read by",
  request: "also called by",
  reply: "also served by",
  call: "also called by",
  execute: "also carried out by",
};

export function markText(overlay, mark) {
  if (!overlay || mark === "both") return "";
  return mark === "first" ? overlay.first : overlay.second;
}
