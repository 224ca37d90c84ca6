// Values over all lights, or views, for one position: directions lie on the disk of their x and y.
uniform vec2 u;
uniform float sigma;
uniform vec3 omega;  // of the view, or of the light
uniform bool over_views;
uniform float min_cos;
in vec2 place;
out vec4 color;
void main() {
  vec2 disk = 2.0 * place - 1.0;
  float z2 = 1.0 - dot(disk, disk);
  color = vec4(0.0);
  if (z2 < min_cos * min_cos) return;
  vec3 other = vec3(disk, sqrt(z2));
  vec3 omega_o = over_views ? other : omega, omega_i = over_views ? omega : other;
  color = vec4(stage2(stage1(u, sigma, omega_o), omega_i, omega_o), 1.0);
}
