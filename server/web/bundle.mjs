// Bundles the parts of PlayCanvas that the viewer uses into one file, with half the bytes of the whole engine.
//
//     node server/web/bundle.mjs TARGET

import { readFile } from "node:fs/promises";
import { build } from "esbuild";

/** What viewer/splats.js takes from PlayCanvas; a test compares them. */
export const USED = [
  "AppBase", "AppOptions", "Asset", "CameraComponentSystem", "Color", "createGraphicsDevice", "DEVICETYPE_WEBGL2", "Entity",
  "GSPLATDATA_LARGE", "GSplatComponentSystem", "GSplatHandler", "Mat4", "Picker", "PIXELFORMAT_R8", "Quat", "SHADERLANGUAGE_GLSL",
  "ShaderChunks", "Texture", "TextureHandler", "TONEMAP_NONE", "version", "WORKBUFFER_UPDATE_ONCE",
];

/** The viewer draws with WebGL 2, so the shaders of WebGPU are left out: each of their modules exports an empty text. */
const withoutWebGPU = {
  name: "without WebGPU",
  setup(/** @type {any} */ { onLoad }) {
    onLoad({ filter: /[\\/]shader-lib[\\/]wgsl[\\/]chunks[\\/].*\.js$/ }, async (/** @type {any} */ { path }) => {
      const source = await readFile(path, "utf8");
      const names = [...source.matchAll(/export\s*\{([^}]*)\}/g)].flatMap(([, list]) => list.split(","));
      const exported = names.map((name) => name.trim().split(/\s+as\s+/).pop());
      return { contents: exported.map((name) => (name === "default" ? 'export default "";' : `export const ${name} = "";`)).join("\n") };
    });
  },
};

await build({
  stdin: { contents: `export { ${USED.join(", ")} } from "playcanvas";`, resolveDir: import.meta.dirname },
  outfile: process.argv[2],
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  conditions: ["production"],
  drop: ["console"], // as PlayCanvas' own small build does: the viewer says itself what could not be loaded
  plugins: [withoutWebGPU],
  logLevel: "error",
});
