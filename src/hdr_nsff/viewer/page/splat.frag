#version 300 es
// A Gaussian's share of a pixel, premultiplied.
precision highp float;

const float ALPHA_MIN = 1.0 / 255.0; // below, alpha counts as 0
const float ALPHA_MAX = 0.999;
const float MAX_HALF = 65504.0;

flat in vec4 v_feature;
flat in vec3 v_conic;
in vec2 v_offset;
out vec4 color;

void main() {
  vec2 e = vec2(v_conic.x * v_offset.x, v_conic.y * v_offset.x + v_conic.z * v_offset.y);
  float alpha = min(v_feature.a * exp(-dot(e, e)), ALPHA_MAX);
  if (alpha < ALPHA_MIN) discard;
  color = vec4(clamp(v_feature.rgb * alpha, -MAX_HALF, MAX_HALF), alpha);
}
