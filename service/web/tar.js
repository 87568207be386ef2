// Tar: files of a folder as one archive, without reading them into memory.

const BLOCK = 512;

/**
 * The archive (POSIX ustar) of these files.
 * @param {{path: string, file: File}[]} entries
 * @returns {Blob}
 */
export function tar(entries) {
  const parts = entries.flatMap(({ path, file }) => [header(path, file.size), file, new Uint8Array((BLOCK - (file.size % BLOCK)) % BLOCK)]);
  return new Blob([...parts, new Uint8Array(2 * BLOCK)], { type: "application/x-tar" });
}

function header(path, size) {
  const block = new Uint8Array(BLOCK);
  const put = (text, at) => block.set(new TextEncoder().encode(text), at);
  const octal = (number, digits) => number.toString(8).padStart(digits, "0");
  const [prefix, name] = split(path);
  put(name, 0);
  put(octal(0o644, 7), 100);
  put(octal(0, 7), 108);
  put(octal(0, 7), 116);
  put(octal(size, 11), 124);
  put(octal(0, 11), 136);
  put("        0", 148); // spaces in place of the checksum, then the type of a plain file
  put("ustar\u000000", 257);
  put(prefix, 345);
  put(octal(block.reduce((sum, byte) => sum + byte, 0), 6) + "\u0000 ", 148);
  return block;
}

/** Names of more than 100 bytes are cut at a slash. */
function split(path) {
  const bytes = (text) => new TextEncoder().encode(text).length;
  if (bytes(path) <= 100) return ["", path];
  for (let at = path.indexOf("/"); at >= 0; at = path.indexOf("/", at + 1)) {
    const [prefix, name] = [path.slice(0, at), path.slice(at + 1)];
    if (bytes(prefix) <= 155 && bytes(name) <= 100) return [prefix, name];
  }
  throw new Error(`${path}: the name is too long for an archive. Shorten the names of its folders.`);
}

/**
 * The files of a dropped folder.
 * @param {FileSystemEntry} entry
 * @returns {Promise<{path: string, file: File}[]>}
 */
export async function filesOf(entry) {
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    return [{ path: entry.fullPath.slice(1), file }];
  }
  const reader = entry.createReader();
  const found = [];
  for (;;) { // a reader gives some entries at a time, in the end none
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) break;
    for (const inner of some) found.push(...(await filesOf(inner)));
  }
  return found;
}
