// Validates surface.glb with the Khronos glTF validator: 0 errors and 0 warnings.
//   node tests/js/validate_glb.mjs OUT/surface.glb
// The package gltf-validator must be resolvable from here or from the folder named by GLTF_VALIDATOR
// (npm install --prefix FOLDER gltf-validator).
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join, resolve } from "node:path";

const base = process.env.GLTF_VALIDATOR ? join(resolve(process.env.GLTF_VALIDATOR), "package.json") : import.meta.url;
const validator = createRequire(base)("gltf-validator");
const files = process.argv.slice(2);
if (files.length === 0 && process.env.VASCULUM_OUT) files.push(join(process.env.VASCULUM_OUT, "surface.glb"));
if (files.length === 0) {
  console.error("usage: node validate_glb.mjs FILE.glb ...");
  process.exit(2);
}
let bad = 0;
for (const file of files) {
  const report = await validator.validateBytes(new Uint8Array(await readFile(file)), { uri: file, maxIssues: 50 });
  const { numErrors, numWarnings, numInfos, numHints, messages } = report.issues;
  console.log(`${file}: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints; ` +
    `${report.info.totalTriangleCount} triangles, ${report.info.drawCallCount} draw calls`);
  for (const m of messages) console.log(`  ${m.code} ${m.pointer ?? ""}: ${m.message}`);
  bad += numErrors + numWarnings;
}
process.exit(bad === 0 ? 0 : 1);
