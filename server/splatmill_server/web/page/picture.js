// The picture of a model.

/** From the start view that was chosen, and the one that the training made. */
export const [POSTER, PREVIEW] = ["poster.jpg", "preview.jpg"];

/**
 * The name of the picture that stands for a model; undefined where it has none.
 * @param {{name: string}[]} files those of the model
 */
export function pictureOf(files) {
  return [POSTER, PREVIEW].find((picture) => files.some(({ name }) => name === picture));
}
