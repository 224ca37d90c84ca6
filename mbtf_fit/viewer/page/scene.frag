// A shape with the material: radiance towards the camera, in units of the lights' irradiance.
const int MOST_LIGHTS = 4;
uniform int light_count;
uniform vec3 light_direction[MOST_LIGHTS];
uniform vec3 light_color[MOST_LIGHTS];
uniform bool has_environment;
uniform sampler2D environment_samples;  // two rows per sample: direction, radiance over density
uniform float environment_angle;
uniform vec3 environment_color;
uniform int frame;
uniform vec3 camera;
uniform float min_cos;
uniform int shown;  // 0: radiance; 1: u, v, sigma; 2: view in the tile's frame; 3: visited nodes
in vec3 world;
in vec3 normal_there;
in vec4 tangent_there;
in vec2 uv_there;
out vec4 color;

// Directions below the data's smallest cosine are raised to it.
vec3 raised(vec3 w) {
  float sine = length(w.xy), largest = sqrt(1.0 - min_cos * min_cos);
  return w.z < min_cos ? vec3(w.xy * (sine > 0.0 ? largest / sine : 0.0), min_cos) : w;
}

uint hash(uint x) {
  x ^= x >> 16; x *= 0x7feb352du; x ^= x >> 15; x *= 0x846ca68bu; x ^= x >> 16;
  return x;
}

void main() {
  // The pixel's filter has a standard deviation of half a pixel; the footprint is isotropic.
  vec2 dx = dFdx(uv_there) * vec2(1.0, ASPECT), dy = dFdy(uv_there) * vec2(1.0, ASPECT);
  float sigma = 0.5 * sqrt(abs(dx.x * dy.y - dx.y * dy.x));
  vec3 n = normalize(normal_there), towards = normalize(camera - world);
  vec3 t = normalize(tangent_there.xyz - n * dot(n, tangent_there.xyz));
  float hand = tangent_there.w;
  // Both sides of open shapes have the material. At a silhouette normals between vertices may point away: then
  // the triangle decides which side is seen.
  vec3 facet = cross(dFdx(world), dFdy(world));
  if (dot(n, towards) < 0.0 && dot(n, facet) * dot(facet, towards) < 0.0) { n = -n; hand = -hand; }
  vec3 b = hand * cross(n, t);
  vec3 view = vec3(dot(towards, t), dot(towards, b), dot(towards, n));
  vec3 omega_o = raised(view);
  if (shown == 1) { color = vec4(uv_there - floor(uv_there), sigma, 1.0); return; }
  if (shown == 2) { color = vec4(omega_o, 1.0); return; }
  Seen seen = stage1(uv_there, sigma, omega_o);
  vec3 sum = vec3(0.0);
  int count = light_count + (has_environment ? 1 : 0);
  for (int k = 0; k < count; k++) {
    vec3 direction, radiance;
    if (k < light_count) {
      direction = light_direction[k];
      radiance = light_color[k];
    } else {
      uint pixel = uint(gl_FragCoord.x) * 1973u + uint(gl_FragCoord.y) * 9277u;
      int s = int((hash(pixel) + uint(frame) * 2654435769u) >> 20);
      direction = texelFetch(environment_samples, ivec2(s & 63, 2 * (s >> 6)), 0).xyz;
      radiance = texelFetch(environment_samples, ivec2(s & 63, 2 * (s >> 6) + 1), 0).rgb * environment_color;
      float c = cos(environment_angle), d = sin(environment_angle);
      direction.xy = vec2(c * direction.x - d * direction.y, d * direction.x + c * direction.y);
    }
    vec3 light = vec3(dot(direction, t), dot(direction, b), dot(direction, n));
    if (light.z <= 0.0) continue;
    sum += radiance * light.z * stage2(seen, raised(light), omega_o);
  }
#ifdef TRACED
  if (shown == 3) { color = vec4(visited); return; }
#endif
  color = vec4(sum, 1.0 - transmittance(uv_there, sigma, omega_o));
}
