// Bundles app/ into the folder named on the command line: main.js, and view3d.js with three.js, which is fetched when a
// result is opened. What both need goes into a chunk of its own.
import { build } from "esbuild";

await build({
  entryPoints: ["app/main.js", "app/view3d.js"],
  bundle: true,
  splitting: true,
  format: "esm",
  minify: true,
  legalComments: "inline",
  target: "es2022",
  outdir: process.argv[2],
});
