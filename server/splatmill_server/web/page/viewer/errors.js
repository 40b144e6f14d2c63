/** What a tool says that needs the view before it is there. */
export const LOADING = "The model is still being loaded. Try again in a moment.";

/** Why a model cannot be shown. */
export class ViewerError extends Error {
  /**
   * @param {"no_webgl" | "no_engine" | "unreadable" | "refused" | "format" | "empty"} reason
   * @param {string} message  a sentence for the person in front of the page
   * @param {ErrorOptions} [options]
   */
  constructor(reason, message, options) {
    super(message, options);
    this.reason = reason;
  }
}
