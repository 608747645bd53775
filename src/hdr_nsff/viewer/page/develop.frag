#version 300 es
// From composited maps to the screen: exposure, a curve, and the views of other maps.
precision highp float;
precision highp int;
precision highp sampler2D;

const int CAMERA = 0, AGX = 1, PBR_NEUTRAL = 2, REINHARD = 3, CLIP = 4, EXTENDED = 5;
const int VIEW_RADIANCE = 0, VIEW_DEPTH = 1, VIEW_MOTION = 2, VIEW_FLOW = 3;
const float CURVE_SIZE = 1024.0; // entries of the learned curve, even in x^(1/2.2)
const float REINHARD_WHITE = 40.0; // exposed luminance that becomes white, as `render` has it
const float MID_GRAY = 0.18;
// Of HDR screens, as the HDR videos have them: 1 is diffuse white, 203 nits; light above
// 500 nits rolls off into the peak of 1000.
const float KNEE = 500.0 / 203.0, PEAK = 1000.0 / 203.0;

uniform sampler2D u_maps;
uniform sampler2D u_response;
uniform bool u_flipped; // rows from the top
uniform int u_view, u_curve;
uniform vec3 u_gain; // exposure times white balance
uniform float u_responseEnd; // exposure at the last entry of the learned curve
uniform bool u_clipping, u_falseColor;
uniform vec2 u_depthRange; // near, far
uniform float u_maxFlow; // pixels

in vec2 v_position;
out vec4 color;

float luminance(vec3 rgb) {
  return dot(rgb, vec3(0.2126, 0.7152, 0.0722));
}

vec3 encodeExtended(vec3 linear) { // sRGB, which continues above 1 by its formula
  vec3 x = max(linear, 0.0);
  vec3 power = 1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
  return mix(power, 12.92 * x, vec3(lessThanEqual(x, vec3(0.0031308))));
}

vec3 encode(vec3 linear) { // sRGB
  return encodeExtended(min(linear, 1.0));
}

float response(float exposed, int channel) {
  float share = clamp(exposed / u_responseEnd, 0.0, 1.0);
  float place = pow(share, 1.0 / 2.2) * (CURVE_SIZE - 1.0);
  int low = min(int(place), int(CURVE_SIZE) - 2);
  float a = texelFetch(u_response, ivec2(low, 0), 0)[channel];
  float b = texelFetch(u_response, ivec2(low + 1, 0), 0)[channel];
  return mix(a, b, place - float(low));
}

// AgX by Troy Sobotka, in the polynomial form of Benjamin Wrensch with the Rec. 2020
// matrices of Filament and three.js.
vec3 agx(vec3 rgb) {
  const mat3 TO_REC2020 = mat3(
    0.6274, 0.0691, 0.0164,
    0.3293, 0.9195, 0.0880,
    0.0433, 0.0113, 0.8956);
  const mat3 FROM_REC2020 = mat3(
    1.6605, -0.1246, -0.0182,
    -0.5876, 1.1329, -0.1006,
    -0.0728, -0.0083, 1.1187);
  const mat3 INSET = mat3(
    0.856627153315983, 0.137318972929847, 0.11189821299995,
    0.0951212405381588, 0.761241990602591, 0.0767994186031903,
    0.0482516061458583, 0.101439036467562, 0.811302368396859);
  const mat3 OUTSET = mat3(
    1.1271005818144368, -0.1413297634984383, -0.14132976349843826,
    -0.11060664309660323, 1.157823702216272, -0.11060664309660294,
    -0.016493938717834573, -0.016493938717834257, 1.2519364065950405);
  const float MIN_EV = -12.47393, MAX_EV = 4.026069;
  vec3 x = INSET * (TO_REC2020 * max(rgb, 0.0));
  x = clamp((log2(max(x, 1e-10)) - MIN_EV) / (MAX_EV - MIN_EV), 0.0, 1.0);
  vec3 x2 = x * x, x4 = x2 * x2;
  x = 15.5 * x4 * x2 - 40.14 * x4 * x + 31.96 * x4 - 6.868 * x2 * x + 0.4298 * x2 + 0.1191 * x
    - 0.00232;
  return clamp(FROM_REC2020 * pow(max(OUTSET * x, 0.0), vec3(2.2)), 0.0, 1.0);
}

// Khronos PBR Neutral tone mapper, version 1.0.
vec3 pbrNeutral(vec3 rgb) {
  const float START = 0.8 - 0.04, DESATURATION = 0.15;
  float darkest = min(rgb.r, min(rgb.g, rgb.b));
  rgb -= darkest < 0.08 ? darkest - 6.25 * darkest * darkest : 0.04;
  float peak = max(rgb.r, max(rgb.g, rgb.b));
  if (peak < START) return rgb;
  float d = 1.0 - START, newPeak = 1.0 - d * d / (peak + d - START);
  rgb *= newPeak / peak;
  return mix(rgb, vec3(newPeak), 1.0 - 1.0 / (DESATURATION * (peak - newPeak) + 1.0));
}

// Reinhard et al. 2002, eq. 4, on luminance: the look of the videos of `render`.
vec3 reinhard(vec3 rgb) {
  float y = luminance(rgb);
  float mapped = min(y * (1.0 + y / (REINHARD_WHITE * REINHARD_WHITE)) / (1.0 + y), 1.0);
  vec3 scaled = rgb * (mapped / max(y, 1e-9));
  float largest = max(scaled.r, max(scaled.g, scaled.b));
  float gray = clamp((largest - 1.0) / max(largest - mapped, 1e-9), 0.0, 1.0);
  return mix(scaled, vec3(mapped), gray);
}

// By one factor per pixel, so that hue is kept; a hyperbola whose slope at the knee is 1.
vec3 rollOff(vec3 rgb) {
  float level = max(rgb.r, max(rgb.g, rgb.b));
  if (level <= KNEE) return rgb;
  float excess = (level - KNEE) / (PEAK - KNEE);
  return rgb * ((KNEE + (PEAK - KNEE) * excess / (1.0 + excess)) / level);
}

vec3 develop(vec3 exposed) {
  switch (u_curve) {
    case CAMERA:
      return vec3(response(exposed.r, 0), response(exposed.g, 1), response(exposed.b, 2));
    case AGX: return encode(agx(exposed));
    case PBR_NEUTRAL: return encode(pbrNeutral(exposed));
    case REINHARD: return encode(reinhard(exposed));
    case EXTENDED: return encodeExtended(rollOff(exposed));
  }
  return encode(exposed);
}

// Stops from mid gray as colors, about two stops a band.
vec3 falseColor(vec3 exposed) {
  float stops = log2(max(luminance(exposed), 1e-9) / MID_GRAY);
  if (stops < -6.0) return vec3(0.16, 0.0, 0.3);
  if (stops < -4.0) return vec3(0.1, 0.25, 0.75);
  if (stops < -2.0) return vec3(0.1, 0.6, 0.8);
  if (stops < -0.5) return vec3(0.35, 0.45, 0.4);
  if (stops < 0.5) return vec3(0.35, 0.75, 0.3);
  if (stops < 2.0) return vec3(0.75, 0.72, 0.6);
  if (stops < 4.0) return vec3(0.98, 0.85, 0.2);
  if (stops < 6.0) return vec3(0.95, 0.5, 0.1);
  return vec3(0.9, 0.1, 0.1);
}

// Turbo, as a polynomial (Mikhailov, Google 2019).
vec3 turbo(float x) {
  x = clamp(x, 0.0, 1.0);
  vec4 v = vec4(1.0, x, x * x, x * x * x);
  vec2 w = v.zw * v.z;
  float red = dot(v, vec4(0.13572138, 4.61539260, -42.66032258, 132.13108234));
  float green = dot(v, vec4(0.09140261, 2.19418839, 4.84296658, -14.18503333));
  float blue = dot(v, vec4(0.10667330, 12.64194608, -60.58204836, 110.36276771));
  red += dot(w, vec2(-152.94239396, 59.28637943));
  green += dot(w, vec2(4.27729857, 2.82956604));
  blue += dot(w, vec2(-89.90310912, 27.34824973));
  return clamp(vec3(red, green, blue), 0.0, 1.0);
}

vec3 flowColor(vec2 flow) {
  float hue = atan(flow.y, flow.x) / 6.28318530718 + 0.5;
  vec3 wheel = clamp(abs(mod(hue * 6.0 + vec3(0.0, 4.0, 2.0), 6.0) - 3.0) - 1.0, 0.0, 1.0);
  return wheel * clamp(length(flow) / u_maxFlow, 0.0, 1.0);
}

void main() {
  ivec2 size = textureSize(u_maps, 0);
  vec2 place = u_flipped ? vec2(v_position.x, 1.0 - v_position.y) : v_position;
  vec4 maps = texelFetch(u_maps, min(ivec2(place * vec2(size)), size - 1), 0);
  color.a = 1.0;
  if (u_view == VIEW_DEPTH) {
    float near = u_depthRange.x, far = u_depthRange.y;
    float depth = maps.a > 0.001 ? clamp(maps.r / maps.a, near, far) : far;
    color.rgb = turbo((1.0 / depth - 1.0 / far) / (1.0 / near - 1.0 / far));
    return;
  }
  if (u_view == VIEW_MOTION) {
    color.rgb = mix(vec3(0.07), vec3(1.0, 0.62, 0.15), clamp(maps.g, 0.0, 1.0));
    return;
  }
  if (u_view == VIEW_FLOW) {
    color.rgb = flowColor(maps.rg);
    return;
  }
  vec3 exposed = maps.rgb * u_gain;
  if (u_falseColor) {
    color.rgb = falseColor(exposed);
    return;
  }
  color.rgb = develop(exposed);
  float stripe = mod(gl_FragCoord.x + gl_FragCoord.y, 12.0);
  if (u_clipping && stripe < 6.0) {
    float brightest = max(color.r, max(color.g, color.b));
    if (brightest > 0.997 && u_curve != EXTENDED) color.rgb = vec3(0.95, 0.1, 0.15);
    if (brightest < 0.004) color.rgb = vec3(0.15, 0.3, 1.0);
  }
}
