// One triangle that covers the target.
// In:  nothing.   Out: position.
// Twin: none; it has no values.

void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 2.0 : 0.0, gl_VertexID == 2 ? 2.0 : 0.0);
    gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0);
}
