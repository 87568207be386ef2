// Shaders. The first program evaluates each Gaussian once for a frame, in the order of drawing; the second one draws.

/** Texels of a Gaussian in the texture of its state: position and opacity, rotation, log-scales. */
export const STATE_TEXELS = 3;
/** Width of all data textures. */
export const TEXTURE_WIDTH = 2048;

/** Y_k of the unit vector v in the basis of 3D Gaussian Splatting, which multiply the harmonics of degree 1 to 3. */
const HARMONICS = `
float harmonic(int k, vec3 v) {
  float x = v.x, y = v.y, z = v.z;
  switch (k) {
    case 0: return 0.28209479177387814;
    case 1: return -0.4886025119029199 * y;
    case 2: return 0.4886025119029199 * z;
    case 3: return -0.4886025119029199 * x;
    case 4: return 1.0925484305920792 * x * y;
    case 5: return -1.0925484305920792 * y * z;
    case 6: return 0.31539156525252005 * (2.0 * z * z - x * x - y * y);
    case 7: return -1.0925484305920792 * x * z;
    case 8: return 0.5462742152960396 * (x * x - y * y);
    case 9: return -0.5900435899266435 * y * (3.0 * x * x - y * y);
    case 10: return 2.890611442640554 * x * y * z;
    case 11: return -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y);
    case 12: return 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y);
    case 13: return -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y);
    case 14: return 1.445305721320277 * z * (x * x - y * y);
    default: return -0.5900435899266435 * x * (x * x - 3.0 * y * y);
  }
}`;

/**
 * The program that evaluates: motion basis, projection (docs/rasterizer.md) and colour of one Gaussian.
 * @param {any} header of the scene
 */
export function evaluationShader(header) {
  const { geometry_rank: rank, residual_rank: residualRank, degree, raster } = header;
  const texels = (numbers) => Math.max(1, Math.ceil(numbers / 4));
  const colorTexels = (degree + 1) ** 2;
  const float = (x) => (Number.isInteger(x) ? `${x}.0` : `${x}`);
  return `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D states, harmonics, geometryWeights, residualWeights;
// Of each function of the geometry three vectors: position, rotation, log-scale; of the residual one.
layout(std140) uniform Functions { vec4 functions[${Math.max(1, 3 * rank + residualRank)}]; };
uniform mat3 rotation;
uniform vec3 center;
uniform vec2 focal, principal, size;
uniform float blur;
in uint index;
out vec4 place, shape, color;

vec4 texel(sampler2D data, int width, int i) {
  int at = int(index) * width + i;
  return texelFetch(data, ivec2(at % ${TEXTURE_WIDTH}, at / ${TEXTURE_WIDTH}), 0);
}
vec4 product(vec4 a, vec4 b) { // quaternions w, x, y, z
  return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}
${HARMONICS}

void main() {
  gl_Position = vec4(0.0, 0.0, 0.0, 1.0);
  place = shape = color = vec4(0.0);
  vec4 mean = texel(states, ${STATE_TEXELS}, 0), quat = texel(states, ${STATE_TEXELS}, 1);
  vec3 logScales = texel(states, ${STATE_TEXELS}, 2).xyz;
  vec3 canonical = mean.xyz;
  float opacity = mean.w;
  vec4 turn = vec4(1.0, 0.0, 0.0, 0.0);
  if (index < ${header.moving}u) {
    for (int i = 0; i < ${rank ? texels(rank) : 0}; i++) {
      vec4 weights = texel(geometryWeights, ${texels(rank)}, i);
      for (int j = 0; j < 4 && 4 * i + j < ${rank}; j++) {
        int at = 3 * (4 * i + j);
        mean.xyz += weights[j] * functions[at].xyz;
        turn += weights[j] * functions[at + 1];
        logScales += weights[j] * functions[at + 2].xyz;
      }
    }
  }
  vec4 change = vec4(0.0);
  if (index < ${header.changing}u) {
    for (int i = 0; i < ${residualRank ? texels(residualRank) : 0}; i++) {
      vec4 weights = texel(residualWeights, ${texels(residualRank)}, i);
      for (int j = 0; j < 4 && 4 * i + j < ${residualRank}; j++) change += weights[j] * functions[${3 * rank} + 4 * i + j];
    }
  }
  opacity += change.w;
  vec3 p = rotation * (mean.xyz - center);
  if (opacity <= ${float(raster.alpha_min)} || p.z <= ${float(raster.near)}) return;
  opacity = min(opacity, 1.0);

  vec4 q = normalize(product(quat, turn));
  vec3 scales = exp(clamp(logScales, ${float(raster.log_scale_range[0])}, ${float(raster.log_scale_range[1])}));
  mat3 turned = mat3(
    1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z),
    2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y),
    2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
  mat3 axes = rotation * turned * mat3(scales.x, 0.0, 0.0, 0.0, scales.y, 0.0, 0.0, 0.0, scales.z);
  vec2 ray = p.xy / p.z;
  // The linear approximation of the projection does not hold far outside the picture.
  vec2 margin = ${float(0.5 * raster.frustum_margin)} * size;
  vec2 held = clamp(ray, -(principal + margin) / focal, (size - principal + margin) / focal);
  vec2 unit = focal / p.z;
  // Rows of Jacobian times axes: the covariance in the picture is that of their products.
  vec3 first = unit.x * (vec3(axes[0].x, axes[1].x, axes[2].x) - held.x * vec3(axes[0].z, axes[1].z, axes[2].z));
  vec3 second = unit.y * (vec3(axes[0].y, axes[1].y, axes[2].y) - held.y * vec3(axes[0].z, axes[1].z, axes[2].z));
  float xx = dot(first, first) + blur, yy = dot(second, second) + blur, xy = dot(first, second);
  vec3 area = cross(first, second);
  // Lagrange's identity: the determinant of a needle without a difference of large numbers.
  float determinant = blur * blur + blur * (dot(first, first) + dot(second, second)) + dot(area, area);
  float half_ = 0.5 * (xx - yy);
  float largest = 0.5 * (xx + yy) + sqrt(half_ * half_ + xy * xy);
  float smallest = determinant / largest;
  vec2 direction = half_ > 0.0 ? vec2(largest - yy, xy) : vec2(xy, largest - xx);
  direction = dot(direction, direction) > 0.0 ? normalize(direction) : vec2(1.0, 0.0);
  float reach = sqrt(2.0 * log(opacity * ${float(1 / raster.alpha_min)})); // deviations at which alpha is the least
  place = vec4(focal * ray + principal, reach, opacity);
  shape = vec4(sqrt(largest) * direction, sqrt(smallest) * vec2(-direction.y, direction.x));

  vec3 towards = normalize(canonical - center);
  color.rgb = vec3(0.5) + change.rgb;
  for (int k = 0; k < ${colorTexels}; k++) color.rgb += harmonic(k, towards) * texel(harmonics, ${colorTexels}, k).rgb;
  color = vec4(clamp(color.rgb, 0.0, 1.0), 1.0);
}`;
}

/** Fragment shader of a program whose vertices are not drawn. */
export const NOTHING = `#version 300 es
precision lowp float;
void main() {}`;

/** A Gaussian's rectangle: the ellipse at which alpha is the least that is drawn, in its own axes. */
export const DRAWING_VERTEX = `#version 300 es
precision highp float;
uniform vec2 size;
in vec2 corner;
in vec4 place, shape, color;
out vec2 deviations;
flat out vec4 tint;
void main() {
  deviations = corner * place.z;
  vec2 at = place.xy + deviations.x * shape.xy + deviations.y * shape.zw;
  tint = vec4(color.rgb, place.w);
  gl_Position = vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, 0.0, 1.0);
}`;

/** @param {any} raster */
export const drawingFragment = (raster) => `#version 300 es
precision highp float;
in vec2 deviations;
flat in vec4 tint;
out vec4 result;
void main() {
  float alpha = tint.a * exp(-0.5 * dot(deviations, deviations));
  if (alpha < ${raster.alpha_min}) discard;
  alpha = min(alpha, ${raster.alpha_max});
  result = vec4(alpha * tint.rgb, alpha);
}`;

export const COPY_VERTEX = `#version 300 es
in vec2 corner;
void main() { gl_Position = vec4(corner, 0.0, 1.0); }`;

/** The mean of parts x parts texels, on the background. */
export const COPY_FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D picture;
uniform int parts;
uniform vec3 background;
out vec4 result;
void main() {
  ivec2 first = ivec2(gl_FragCoord.xy) * parts;
  vec4 sum = vec4(0.0);
  for (int y = 0; y < parts; y++) for (int x = 0; x < parts; x++) sum += texelFetch(picture, first + ivec2(x, y), 0);
  sum /= float(parts * parts);
  result = vec4(sum.rgb + (1.0 - sum.a) * background, 1.0);
}`;
