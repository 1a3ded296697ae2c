// Several files as one zip without compression, made lazily: the parts are the files themselves, only their checksums are
// read beforehand. Names are numbers with the file's own ending, because a name may carry a patient's; pairs (.mhd and .raw,
// .hdr and .img, .nhdr) keep theirs, since one names the other, and the service makes them harmless on arrival.

const TABLE = new Uint32Array(256).map((_, n) => {
  let c = n;
  for (let k = 0; k < 8; k += 1) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
  return c >>> 0;
});
const PAIRED = /\.(mhd|nhdr|hdr|img|raw|zraw|json)$/i;

async function crc32(file, onRead) {
  let crc = 0xffffffff;
  const reader = file.stream().getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return (crc ^ 0xffffffff) >>> 0;
    for (const byte of value) crc = TABLE[(crc ^ byte) & 0xff] ^ (crc >>> 8);
    onRead(value.length);
  }
}

// A record of little-endian fields: [size in bytes, value] each.
function record(fields) {
  const view = new DataView(new ArrayBuffer(fields.reduce((n, [size]) => n + size, 0)));
  let at = 0;
  for (const [size, value] of fields) {
    if (size === 2) view.setUint16(at, value, true);
    else view.setUint32(at, value, true);
    at += size;
  }
  return view.buffer;
}

const ending = (name) => (/\.[A-Za-z0-9]{1,5}$/.exec(name)?.[0] ?? "").toLowerCase();

// The name of a file inside the zip.
export const inside = (file, i) => (PAIRED.test(file.name) ? file.name : `${String(i).padStart(6, "0")}${ending(file.name)}`);

// Natural order: slice 2 before slice 10.
const byName = new Intl.Collator("en", { numeric: true });
export const inOrder = (files) => [...files].sort((a, b) => byName.compare(a.webkitRelativePath || a.name, b.webkitRelativePath || b.name));

// The zip of files as a Blob; onRead is told the bytes whose checksum is done.
export async function zipOf(files, onRead) {
  const parts = [];
  const directory = [];
  let offset = 0;
  for (const [i, file] of inOrder(files).entries()) {
    const name = new TextEncoder().encode(inside(file, i));
    const crc = await crc32(file, onRead);
    // version 2.0, names in UTF-8, stored, 1 January 1980
    const common = [[2, 20], [2, 0x800], [2, 0], [2, 0], [2, 0x21], [4, crc], [4, file.size], [4, file.size], [2, name.length], [2, 0]];
    parts.push(record([[4, 0x04034b50], ...common]), name, file);
    directory.push(record([[4, 0x02014b50], [2, 20], ...common, [2, 0], [2, 0], [2, 0], [4, 0], [4, offset]]), name);
    offset += 30 + name.length + file.size;
  }
  const size = directory.reduce((n, part) => n + part.byteLength, 0);
  const count = files.length;
  const end = record([[4, 0x06054b50], [2, 0], [2, 0], [2, count], [2, count], [4, size], [4, offset], [2, 0]]);
  return new Blob([...parts, ...directory, end], { type: "application/zip" });
}
