// What to do about a problem, for people on these pages: where the server's advice is a request of the REST API, it is
// replaced by what the pages offer.

/** A request of the API, or a header of one. */
const REQUEST = /\b(GET|POST|PUT|PATCH|DELETE) \/|\/v1\/|\bheader\b/;

/** By the code of the problem. @type {Record<string, string>} */
const ADVICE = {
  body_too_large: "Give the files one by one, or smaller ones.",
  capture_in_use: "Cancel the job first, or wait until it has ended.",
  capture_not_found: "The photos may have been deleted. Begin with new ones.",
  cursor_invalid: "Reload the page.",
  file_not_found: "It may have been deleted. Reload the page for the current list.",
  forbidden: "Sign in with a key that permits it; an admin of the server makes one.",
  invalid_request: "Reload the page and try again.",
  job_finished: "Delete it if it is no longer needed.",
  job_not_found: "It may have been deleted. The list of jobs shows those that are there.",
  job_running: "Cancel it first, or wait until it has ended.",
  mesh_not_found: "It may have been deleted. Reload the page for the current list.",
  model_corrupt: "Restart its job.",
  model_in_use: "Cancel the job that starts from it first, or wait until it has ended.",
  model_not_found: "It may have been deleted. The list of models shows those that are there.",
  model_not_ready: "Wait until its job has ended.",
  no_images: "Give photos, a video or a zip first.",
  not_in_bin: "It was restored, or deleted for good after a day. Reload the page for the current list.",
  orbit_not_found: "It may have been deleted. Reload the page for the current list.",
  session_needs_key: "Sign in with a key.",
  share_not_found: "It may have been deleted with its model.",
  snapshot_not_ready: "Wait: a job shows itself while it trains and is watched.",
  too_many_followers: "Close other pages of this server, or try again later.",
  too_many_jobs: "Cancel a job, or wait until one has ended.",
  too_many_meshes: "Delete meshes that are no longer needed.",
  too_many_orbits: "Delete videos that are no longer needed.",
  too_many_requests: "End or delete some that are no longer needed, or wait.",
  unauthorized: "Sign in again.",
  unsupported_media_type: "Reload the page and try again.",
  upload_completed: "Nothing more is needed.",
  upload_not_found: "Give the files again.",
};

/** @param {{code: string, advice: string}} problem */
export function adviceOf({ code, advice }) {
  return REQUEST.test(advice) ? ADVICE[code] ?? "" : advice;
}
