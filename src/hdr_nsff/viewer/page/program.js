// A shader program of WebGL2.

/** A shader program whose uniforms are set by name. */
export class Program {
  constructor(gl, vertexSource, fragmentSource) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [kind, source] of [
      [gl.VERTEX_SHADER, vertexSource],
      [gl.FRAGMENT_SHADER, fragmentSource],
    ]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source.trimStart());
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
        throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS))
      throw new Error(gl.getProgramInfoLog(this.program));
    this.uniforms = new Map();
    const count = gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) {
      const { name, type, size } = gl.getActiveUniform(this.program, i);
      for (let k = 0; k < size; k++) {
        const entry = size > 1 || name.endsWith("[0]") ? name.replace("[0]", `[${k}]`) : name;
        this.uniforms.set(entry, { type, place: gl.getUniformLocation(this.program, entry) });
      }
    }
  }

  use() {
    this.gl.useProgram(this.program);
  }

  set(name, value) {
    const { gl } = this;
    const uniform = this.uniforms.get(name);
    if (!uniform) return; // not used by this program
    const { type, place } = uniform;
    switch (type) {
      case gl.FLOAT:
        return gl.uniform1f(place, value);
      case gl.FLOAT_VEC2:
        return gl.uniform2fv(place, value);
      case gl.FLOAT_VEC3:
        return gl.uniform3fv(place, value);
      case gl.FLOAT_VEC4:
        return gl.uniform4fv(place, value);
      case gl.FLOAT_MAT3:
        return gl.uniformMatrix3fv(place, false, value);
      case gl.INT_VEC4:
        return gl.uniform4iv(place, value);
      default:
        return gl.uniform1i(place, value);
    }
  }

  texture(name, unit, { kind, texture }) {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(kind, texture);
    this.set(name, unit);
  }
}
