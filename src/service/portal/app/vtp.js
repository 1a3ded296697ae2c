// Arrays of a .vtp file by name, read by ranges: its head says where each lies, and no more of it is fetched than is asked for.
import { call } from "./net.js";

const HEAD = 16_384;
const MARK = '<AppendedData encoding="raw">';
const TYPES = { Int32: Int32Array, Float64: Float64Array, Float32: Float32Array };

async function part(path, from, to, signal) {
  const response = await call(path, { headers: { range: `bytes=${from}-${to}` }, signal });
  const bytes = await response.arrayBuffer();
  // Whoever does not know ranges sends the whole.
  return response.status === 206 ? bytes : bytes.slice(from, to + 1);
}

// {name: typed array}; a name that the file lacks is left out.
export async function vtpArrays(path, names, signal) {
  const head = new TextDecoder("latin1").decode(await part(path, 0, HEAD - 1, signal));
  const data = head.indexOf(MARK);
  if (data < 0) throw new Error(`${path}: no appended data in its first ${HEAD} bytes`);
  // An underscore stands before the first byte.
  const start = head.indexOf("_", data + MARK.length) + 1;
  const found = {};
  for (const name of names) {
    const tag = [...head.slice(0, data).matchAll(/<DataArray [^>]*>/g)].map((m) => m[0]).find((text) => text.includes(`Name="${name}"`));
    const Kind = TYPES[/type="(\w+)"/.exec(tag)?.[1]];
    if (!Kind) continue;
    const at = start + Number(/offset="(\d+)"/.exec(tag)[1]);
    // Each array begins with its length in bytes.
    const length = Number(new DataView(await part(path, at, at + 7, signal)).getBigUint64(0, true));
    found[name] = new Kind(await part(path, at + 8, at + 7 + length, signal));
  }
  return found;
}
