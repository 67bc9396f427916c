// Builds into sros_tool/report/assets the script, the style sheets, and the licences of what is in
// them; view.html there is written by hand.

import { build } from "esbuild";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const out = process.argv[2] ?? join(here, "..", "sros_tool", "report", "assets");
const common = { bundle: true, minify: true, legalComments: "none", logLevel: "warning", absWorkingDir: here };

const { metafile } = await build({
  ...common,
  entryPoints: ["src/main.js"],
  outfile: join(out, "view.js"),
  format: "iife",
  target: "es2022",
  charset: "ascii",
  metafile: true,
});
await build({ ...common, entryPoints: ["src/view.css", "src/demo.css"], outdir: out });

const packages = new Set();
for (const input of Object.keys(metafile.inputs)) {
  const found = input.match(/^node_modules\/((?:@[^/]+\/)?[^/]+)\//);
  if (found) packages.add(found[1]);
}
const texts = [...packages].sort().map((name) => {
  const folder = join(here, "node_modules", name);
  const { version } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  const file = readdirSync(folder).find((each) => /^licen[cs]e(\.|$)/i.test(each));
  if (!file) throw new Error(`${name} has no licence file`);
  return `${name} ${version}\n\n${readFileSync(join(folder, file), "utf8").trim()}\n`;
});
writeFileSync(join(out, "view.js.LICENSES.txt"), texts.join(`\n${"-".repeat(72)}\n\n`));
