// The client of resumable uploads, in a module of its own: a build without npm puts a stand-in here.
export { Upload } from "tus-js-client";

export const available = true;
