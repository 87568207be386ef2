// Renderer: draws a scene with WebGL2 as graings.raster does, from back to front instead of front to back.

import { relativeRate, undersampling } from "./camera.js";
import { functionsAt } from "./scene_file.js";
import * as shaders from "./shaders.js";

const MAX_PARTS = 4; // samples for each pixel along each axis
const MAX_SIDE = 4096; // of the supersampled picture, in px
const VECTORS = 3; // that the first program hands to the second one, of four floats each

export class Renderer {
  /** Whether this browser can draw scenes. */
  static isSupported() {
    const gl = document.createElement("canvas").getContext("webgl2");
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return Boolean(gl);
  }

  /**
   * Throws where the browser has no WebGL2.
   * @param {HTMLCanvasElement} canvas
   * @param {import("./scene_file.js").Scene} scene
   */
  constructor(canvas, scene) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("This browser has no WebGL2.");
    this.gl = gl;
    this.canvas = canvas;
    this.scene = scene;
    const { header, geometry, residual } = scene;
    const vectors = Math.max(1, 3 * geometry.rank + residual.rank);
    if (16 * vectors > gl.getParameter(gl.MAX_UNIFORM_BLOCK_SIZE)) throw new Error("The motion of this scene has too many functions for this browser.");
    // Sums of hundreds of faint Gaussians need more than the eight bits of the canvas.
    this.fine = gl.getExtension("EXT_color_buffer_float") !== null;
    this.vectors = new Float32Array(4 * vectors);
    this.geometry = new Float32Array(10 * geometry.rank);
    this.residual = new Float32Array(4 * residual.rank);
    this.evaluation = program(gl, shaders.evaluationShader(header), shaders.NOTHING, ["place", "shape", "color"]);
    this.drawing = program(gl, shaders.DRAWING_VERTEX, shaders.drawingFragment(header.raster));
    this.copying = program(gl, shaders.COPY_VERTEX, shaders.COPY_FRAGMENT);
    this.upload();
    this.arrange();
    this.target = null;
    this.shown = 0;
  }

  /** The scene as textures, a Gaussian's texels side by side. */
  upload() {
    const { gl, scene } = this;
    const { count, means, quats, logScales, opacities, harmonics, header } = scene;
    const of = (table, column, i) => table[column * count + i];
    const states = table(count, shaders.STATE_TEXELS, (data, at, i) => {
      for (let axis = 0; axis < 3; axis++) {
        data[at + axis] = of(means, axis, i);
        data[at + 8 + axis] = of(logScales, axis, i);
      }
      data[at + 3] = opacities[i];
      for (let part = 0; part < 4; part++) data[at + 4 + part] = of(quats, part, i);
    });
    const terms = (header.degree + 1) ** 2;
    const colors = table(count, terms, (data, at, i) => {
      for (let k = 0; k < terms; k++) for (let c = 0; c < 3; c++) data[at + 4 * k + c] = of(harmonics, 3 * k + c, i);
    });
    const weights = ({ rank, rows, weights: columns }) =>
      table(rows, Math.max(1, Math.ceil(rank / 4)), (data, at, i) => {
        for (let r = 0; r < rank; r++) data[at + r] = columns[r * rows + i];
      });
    const textures = [
      ["states", states, gl.RGBA32F],
      ["harmonics", colors, gl.RGBA16F],
      ["geometryWeights", weights(scene.geometry), gl.RGBA16F],
      ["residualWeights", weights(scene.residual), gl.RGBA16F],
    ];
    gl.useProgram(this.evaluation);
    textures.forEach(([name, data, format], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      texture(gl);
      const height = data.length / 4 / shaders.TEXTURE_WIDTH;
      gl.texImage2D(gl.TEXTURE_2D, 0, format, shaders.TEXTURE_WIDTH, height, 0, gl.RGBA, gl.FLOAT, data);
      gl.uniform1i(gl.getUniformLocation(this.evaluation, name), unit);
    });
    gl.activeTexture(gl.TEXTURE0 + textures.length);
    gl.useProgram(this.copying);
    gl.uniform1i(gl.getUniformLocation(this.copying, "picture"), textures.length);
  }

  /** Buffers and how the programs read them. */
  arrange() {
    const { gl, scene } = this;
    this.uniforms = gl.createBuffer();
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.uniforms);
    gl.bufferData(gl.UNIFORM_BUFFER, this.vectors.byteLength, gl.DYNAMIC_DRAW);
    gl.uniformBlockBinding(this.evaluation, gl.getUniformBlockIndex(this.evaluation, "Functions"), 0);
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.uniforms);
    const buffer = (bytes, usage) => {
      const made = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, made);
      gl.bufferData(gl.ARRAY_BUFFER, bytes, usage);
      return made;
    };
    const attribute = (used, name, size, type, stride, offset, divisor) => {
      const place = gl.getAttribLocation(used, name);
      gl.enableVertexAttribArray(place);
      if (type === gl.UNSIGNED_INT) gl.vertexAttribIPointer(place, size, type, stride, offset);
      else gl.vertexAttribPointer(place, size, type, false, stride, offset);
      gl.vertexAttribDivisor(place, divisor);
    };
    this.evaluated = gl.createVertexArray();
    gl.bindVertexArray(this.evaluated);
    this.indices = buffer(4 * scene.count, gl.DYNAMIC_DRAW);
    attribute(this.evaluation, "index", 1, gl.UNSIGNED_INT, 0, 0, 0);
    this.drawn = gl.createVertexArray();
    gl.bindVertexArray(this.drawn);
    this.corners = buffer(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    attribute(this.drawing, "corner", 2, gl.FLOAT, 0, 0, 0);
    this.results = buffer(16 * VECTORS * scene.count, gl.DYNAMIC_COPY);
    ["place", "shape", "color"].forEach((name, i) => attribute(this.drawing, name, 4, gl.FLOAT, 16 * VECTORS, 16 * i, 1));
    this.copied = gl.createVertexArray();
    gl.bindVertexArray(this.copied);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.corners);
    attribute(this.copying, "corner", 2, gl.FLOAT, 0, 0, 0);
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    this.feedback = gl.createTransformFeedback();
  }

  /**
   * The order in which Gaussians are drawn from now on, farthest first.
   * @param {Uint32Array} order
   */
  setOrder(order) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, order);
    this.shown = order.length;
  }

  /**
   * Draw the scene at a time in [0, 1] on a background, RGB in [0, 1].
   * @param {import("./camera.js").Camera} camera
   * @param {number} time
   * @param {number[]} background
   * @param {boolean} supersampled whether a camera coarser than those of training gets several samples a pixel
   */
  draw(camera, time, background, supersampled = true) {
    const { gl, canvas } = this;
    if (canvas.width !== camera.width || canvas.height !== camera.height) {
      canvas.width = camera.width;
      canvas.height = camera.height;
    }
    const { sampling } = this.scene.header;
    const most = Math.min(supersampled ? MAX_PARTS : 1, Math.floor(MAX_SIDE / Math.max(camera.width, camera.height)));
    const parts = Math.max(1, Math.ceil(Math.min(undersampling(camera, sampling), most)));
    const fine = enlarged(camera, parts);
    this.evaluate(fine, time);
    this.prepareTarget(fine.width, fine.height);
    gl.viewport(0, 0, fine.width, fine.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(this.drawing);
    gl.uniform2f(gl.getUniformLocation(this.drawing, "size"), fine.width, fine.height);
    gl.bindVertexArray(this.drawn);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.shown);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.useProgram(this.copying);
    gl.uniform1i(gl.getUniformLocation(this.copying, "parts"), parts);
    gl.uniform3fv(gl.getUniformLocation(this.copying, "background"), background);
    gl.bindVertexArray(this.copied);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    gl.bindVertexArray(null);
  }

  /** Draw, wait until it is done, and return the milliseconds. */
  measure(camera, time, background) {
    const { gl } = this;
    const started = performance.now();
    this.draw(camera, time, background, false);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return performance.now() - started;
  }

  /** Motion, projection and colour of all Gaussians, in the order of drawing. */
  evaluate(camera, time) {
    const { gl, scene, evaluation, vectors } = this;
    functionsAt(scene.geometry, time, this.geometry);
    functionsAt(scene.residual, time, this.residual);
    for (let r = 0; r < scene.geometry.rank; r++) {
      const [from, to] = [10 * r, 12 * r];
      for (let i = 0; i < 3; i++) {
        vectors[to + i] = this.geometry[from + i];
        vectors[to + 8 + i] = this.geometry[from + 7 + i];
      }
      for (let i = 0; i < 4; i++) vectors[to + 4 + i] = this.geometry[from + 3 + i];
    }
    vectors.set(this.residual, 12 * scene.geometry.rank);
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.uniforms);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, vectors);
    gl.useProgram(evaluation);
    const uniform = (name) => gl.getUniformLocation(evaluation, name);
    gl.uniformMatrix3fv(uniform("rotation"), true, camera.rotation);
    gl.uniform3fv(uniform("center"), camera.center);
    gl.uniform2f(uniform("focal"), camera.fx, camera.fy);
    gl.uniform2f(uniform("principal"), camera.cx, camera.cy);
    gl.uniform2f(uniform("size"), camera.width, camera.height);
    gl.uniform1f(uniform("blur"), scene.header.blur * relativeRate(camera, scene.header.sampling) ** 2);
    gl.bindVertexArray(this.evaluated);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.results);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, this.shown);
    gl.endTransformFeedback();
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
    gl.disable(gl.RASTERIZER_DISCARD);
  }

  /** The framebuffer that is drawn to. */
  prepareTarget(width, height) {
    const { gl } = this;
    if (this.target?.width === width && this.target.height === height) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
      return;
    }
    if (this.target) {
      gl.deleteFramebuffer(this.target.framebuffer);
      gl.deleteTexture(this.target.picture);
    }
    const picture = texture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.fine ? gl.RGBA16F : gl.RGBA8, width, height);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
    this.target = { width, height, framebuffer, picture };
  }

  /** Give the memory back; the canvas cannot be used again. */
  close() {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

/** @returns {import("./camera.js").Camera} the same field of view with `parts` as many pixels on each side */
function enlarged(camera, parts) {
  const { fx, fy, cx, cy, width, height } = camera;
  return { ...camera, fx: fx * parts, fy: fy * parts, cx: cx * parts, cy: cy * parts, width: width * parts, height: height * parts };
}

/** Rows of `texels` texels, in whole lines of a texture. */
function table(rows, texels, fill) {
  const lines = Math.max(1, Math.ceil((rows * texels) / shaders.TEXTURE_WIDTH));
  const data = new Float32Array(4 * lines * shaders.TEXTURE_WIDTH);
  for (let i = 0; i < rows; i++) fill(data, 4 * texels * i, i);
  return data;
}

/** A new texture, bound to the active unit. */
function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return made;
}

/** A linked program; `captured` outputs of its vertex shader are kept, one after the other. */
function program(gl, vertex, fragment, captured = null) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`A shader does not compile: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(made, shader);
  }
  if (captured) gl.transformFeedbackVaryings(made, captured, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(`A program does not link: ${gl.getProgramInfoLog(made)}`);
  return made;
}
