// Bundles view3d.js with three.js into the file named on the command line.
import { build } from "esbuild";

await build({
  entryPoints: ["view3d.js"],
  bundle: true,
  format: "esm",
  minify: true,
  legalComments: "inline",
  target: "es2022",
  outfile: process.argv[2],
});
