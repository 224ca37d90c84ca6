// Values at queries: a column each, with (u, v, sigma), light and view in its rows.
uniform sampler2D queries;
out vec4 color;
void main() {
  int k = int(gl_FragCoord.x);
  vec3 at = texelFetch(queries, ivec2(k, 0), 0).xyz;
  vec3 omega_i = texelFetch(queries, ivec2(k, 1), 0).xyz, omega_o = texelFetch(queries, ivec2(k, 2), 0).xyz;
  color = vec4(stage2(stage1(at.xy, at.z, omega_o), omega_i, omega_o), 1.0);
}
