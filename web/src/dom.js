// Makes elements of HTML and SVG; text is only ever set as text, never as markup.

const SVG = "http://www.w3.org/2000/svg";

function make(element, properties, children) {
  for (const [key, value] of Object.entries(properties)) {
    if (value === undefined || value === null || value === false) continue;
    if (key === "text") element.textContent = value;
    else if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children.flat(2).filter((child) => child !== null && child !== undefined));
  return element;
}

export const el = (tag, properties = {}, ...children) =>
  make(document.createElement(tag), properties, children);

export const svg = (tag, properties = {}, ...children) =>
  make(document.createElementNS(SVG, tag), properties, children);

// A name, of which a line ends after a part rather than within one.
export const breakable = (name) => name.split(/(?<=[/_])/).flatMap((part, at) => (at ? [el("wbr"), part] : [part]));

export const byId = (id) => document.getElementById(id);

// A screen without room for columns side by side.
export const isSmall = () => window.innerWidth <= 720;

export const counted = (number, thing) => `${number} ${thing}${number === 1 ? "" : "s"}`;
