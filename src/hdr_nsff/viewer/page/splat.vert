#version 300 es
// One Gaussian as a quad: moved to a time, projected as `render` does (EWA splatting:
// Zwicker et al. 2001, Kerbl et al. 2023).
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;

const int MAX_GROUPS = 4;
const int WIDTH = 2048; // texels in a row of every table
const float MARGIN = 0.3; // of half the picture: beyond, the projection is linearized at its edge
const float MAX_LOG_RADIANCE = 16.0;
const float MAX_VIEW_LOG_FACTOR = 2.0;
const float MIN_LENGTH = 1e-12;
const float MIN_WINDOW = 0.02; // of a time-local Gaussian: below, it is not alive
const int RADIANCE = 0, GEOMETRY = 1, FLOW = 2; // what is composited

layout(location = 0) in uint index;

// layers: mean and opacity logit; quaternion; log scales and group; log radiance and
// center time; velocity and log duration
uniform sampler2DArray u_gaussians;
uniform sampler2D u_colorOffsets; // knot after knot of every group
uniform sampler2D u_opacityOffsets;
uniform sampler2D u_mixture; // weights of the bases
uniform sampler2D u_sh1; // three texels a Gaussian: red, green, blue
uniform sampler2D u_poses; // row 0: of this time, row 1: of the time that flow goes to

uniform ivec4 u_place[MAX_GROUPS]; // first Gaussian, count, first mixture weight or -1, local
uniform ivec4 u_knots[MAX_GROUPS]; // color: first, knots; opacity: first, knots
uniform float u_motion[MAX_GROUPS];
uniform int u_bases;
uniform bool u_bounded, u_viewDependent;

uniform float u_time; // in frames
uniform float u_share; // of the clip, in [0, 1]
uniform float u_flowTime, u_flowSign;
uniform mat3 u_rotation; // world to camera
uniform vec3 u_translation;
uniform vec3 u_eye;
uniform vec4 u_camera; // fx, fy, cx, cy in pixels
uniform float u_nearest; // z-depth, scene units: nothing nearer is drawn
uniform vec2 u_size; // pixels
uniform float u_blur; // pixels^2 added to 2D variances
uniform int u_feature;

flat out vec4 v_feature; // and opacity
flat out vec3 v_conic;
out vec2 v_offset; // pixels from the center

vec4 gaussian(int i, int layer) {
  return texelFetch(u_gaussians, ivec3(i % WIDTH, i / WIDTH, layer), 0);
}

vec4 entry(sampler2D table, int i) {
  return texelFetch(table, ivec2(i % WIDTH, i / WIDTH), 0);
}

// Linear interpolation between knots spread evenly over the clip.
vec4 atKnots(sampler2D table, int first, int knots, int count, int row) {
  if (knots == 0) return vec4(0.0);
  if (knots == 1) return entry(table, first + row);
  float position = u_share * float(knots - 1);
  int low = min(int(position), knots - 2);
  vec4 a = entry(table, first + low * count + row);
  vec4 b = entry(table, first + (low + 1) * count + row);
  return mix(a, b, position - float(low));
}

vec4 product(vec4 a, vec4 b) { // Hamilton product of w x y z
  return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

mat3 rotation(vec4 q) {
  q /= length(q) + MIN_LENGTH;
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3( // columns
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// A point moved by the mixture of bases at the time of a row of u_poses.
vec3 move(vec3 point, int weights, int row, out vec4 turn) {
  vec4 x = vec4(0.0), y = vec4(0.0), z = vec4(0.0);
  turn = vec4(0.0);
  for (int b = 0; b < u_bases; b++) {
    float weight = entry(u_mixture, weights + b).x;
    x += weight * texelFetch(u_poses, ivec2(4 * b, row), 0);
    y += weight * texelFetch(u_poses, ivec2(4 * b + 1, row), 0);
    z += weight * texelFetch(u_poses, ivec2(4 * b + 2, row), 0);
    turn += weight * texelFetch(u_poses, ivec2(4 * b + 3, row), 0);
  }
  vec4 p = vec4(point, 1.0);
  return vec3(dot(x, p), dot(y, p), dot(z, p));
}

vec2 project(vec3 t) {
  return u_camera.xy * t.xy / max(t.z, u_nearest) + u_camera.zw;
}

vec3 radiance(int i, int group, vec3 mean) {
  ivec4 place = u_place[group], knots = u_knots[group];
  vec3 stored = gaussian(i, 3).rgb;
  stored += atKnots(u_colorOffsets, knots.x, knots.y, place.y, i - place.x).rgb;
  vec3 factor = vec3(1.0);
  if (u_viewDependent) {
    vec3 direction = normalize(mean - u_eye);
    vec3 change = vec3(
      dot(entry(u_sh1, 3 * i).xyz, direction),
      dot(entry(u_sh1, 3 * i + 1).xyz, direction),
      dot(entry(u_sh1, 3 * i + 2).xyz, direction));
    factor = exp(clamp(change, -MAX_VIEW_LOG_FACTOR, MAX_VIEW_LOG_FACTOR));
  }
  if (!u_bounded) return exp(min(stored, MAX_LOG_RADIANCE)) * factor;
  vec3 share = 1.0 / (1.0 + exp(-stored));
  return share * factor / (1.0 - share + share * factor);
}

void main() {
  int i = int(index);
  vec4 meanLogit = gaussian(i, 0), scaleGroup = gaussian(i, 2);
  vec4 quaternion = gaussian(i, 1);
  int group = int(scaleGroup.w + 0.5);
  ivec4 place = u_place[group], knots = u_knots[group];

  // the Gaussian at this time, and its mean at the time that flow goes to
  vec3 mean = meanLogit.xyz, next = mean;
  float opacity = meanLogit.w;
  opacity += atKnots(u_opacityOffsets, knots.z, knots.w, place.y, i - place.x).x;
  opacity = 1.0 / (1.0 + exp(-opacity));
  if (place.z >= 0) {
    int weights = place.z + (i - place.x) * u_bases;
    vec4 turn, unused;
    mean = move(meanLogit.xyz, weights, 0, turn);
    quaternion = product(turn, quaternion);
    if (u_feature == FLOW) next = move(meanLogit.xyz, weights, 1, unused);
  }
  if (place.w == 1) {
    vec4 velocity = gaussian(i, 4);
    float since = u_time - gaussian(i, 3).w;
    float share = since / exp(velocity.w);
    float window = exp(-0.5 * share * share);
    opacity *= window > MIN_WINDOW ? window : 0.0;
    mean += velocity.xyz * since;
    next += velocity.xyz * (since + u_flowTime - u_time);
  }

  v_feature = vec4(0.0);
  v_conic = vec3(0.0);
  v_offset = vec2(0.0);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // beyond the far plane: not drawn
  vec3 t = u_rotation * mean + u_translation;
  if (!(t.z > u_nearest && opacity * 255.0 >= 1.0)) return;

  // the 2D covariance V V^T + blur with V = J W R S
  vec2 edge = MARGIN * 0.5 * u_size / u_camera.xy;
  vec2 low = -u_camera.zw / u_camera.xy - edge;
  vec2 high = (u_size - u_camera.zw) / u_camera.xy + edge;
  vec2 held = clamp(t.xy / t.z, low, high);
  vec3 rowX = u_camera.x / t.z * vec3(1.0, 0.0, -held.x);
  vec3 rowY = u_camera.y / t.z * vec3(0.0, 1.0, -held.y);
  mat3 spread = u_rotation * rotation(quaternion);
  vec3 scale = exp(scaleGroup.xyz);
  vec3 vx = (rowX * spread) * scale, vy = (rowY * spread) * scale;
  float xx = dot(vx, vx) + u_blur, xy = dot(vx, vy), yy = dot(vy, vy) + u_blur;
  // (xx - u_blur)(yy - u_blur) - xy^2 is |vx x vy|^2: exact for needles as well
  vec3 area = cross(vx, vy);
  float det = dot(area, area) + u_blur * (xx + yy) - u_blur * u_blur;
  if (!(det > 0.0)) return;
  float across = sqrt(0.5 * xx / det);
  v_conic = vec3(sqrt(0.5 / xx), -xy / xx * across, across);

  // a quad along the axes of the ellipse where alpha falls below 1/255
  float reach = sqrt(2.0 * log(opacity * 255.0 + 1e-6));
  float middle = 0.5 * (xx + yy), radius = length(vec2(0.5 * (xx - yy), xy));
  float major = middle + radius, minor = max(det / major, 0.0);
  vec2 axis = xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
  if (abs(xy) > 1e-12 * major) axis = normalize(vec2(xy, major - xx));
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  vec2 along = corner.x * reach * sqrt(major) * axis;
  vec2 beside = corner.y * reach * sqrt(minor) * vec2(-axis.y, axis.x);
  v_offset = along + beside;
  vec2 center = project(t);
  vec2 pixel = center + v_offset;
  gl_Position = vec4(2.0 * pixel.x / u_size.x - 1.0, 1.0 - 2.0 * pixel.y / u_size.y, 0.0, 1.0);

  if (u_feature == RADIANCE) v_feature = vec4(radiance(i, group, mean), opacity);
  if (u_feature == GEOMETRY) v_feature = vec4(t.z, u_motion[group], 0.0, opacity);
  if (u_feature == FLOW) {
    vec2 flow = u_flowSign * (project(u_rotation * next + u_translation) - center);
    v_feature = vec4(clamp(flow, -2.0 * u_size.x, 2.0 * u_size.x), 0.0, opacity);
  }
}
