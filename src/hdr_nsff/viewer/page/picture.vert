#version 300 es
// A triangle that covers the picture.
precision highp float;

out vec2 v_position; // in [0, 1], y up

void main() {
  v_position = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0;
  gl_Position = vec4(2.0 * v_position - 1.0, 0.0, 1.0);
}
