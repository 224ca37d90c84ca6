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

// Of more elongated footprints the minor radius is enlarged.
const float MAX_ANISOTROPY = $MAX_ANISOTROPY;

// Quantile of the normal distribution (Winitzki's approximation of the inverse error function).
float normal_quantile(float p) {
  float x = 2.0 * p - 1.0, l = log(max(1.0 - x * x, 1e-7)), q = 4.33 + 0.5 * l;
  // Roots of GPUs are not exact: near the median the difference may be negative.
  return sign(x) * sqrt(2.0 * max(sqrt(q * q - l / 0.147) - q, 0.0));
}

// Place (in tile widths, relative to the pixel's) and sigma of one of the round footprints whose mean is the
// pixel's elongated one. The first frame has the round footprint of the same area.
vec3 round_footprint(vec2 dx, vec2 dy) {
  float area = abs(dx.x * dy.y - dx.y * dy.x);
  if (frame == 0) return vec3(0.0, 0.0, 0.5 * sqrt(area));
  // Squared radii of the ellipse, and the direction of the major one.
  float xy = dx.x * dx.y + dy.x * dy.y, difference = 0.5 * (dx.x * dx.x + dy.x * dy.x - dx.y * dx.y - dy.y * dy.y);
  float major = 0.5 * (dot(dx, dx) + dot(dy, dy)) + length(vec2(difference, xy));
  float minor = max(area * area / max(major, 1e-20), major / (MAX_ANISOTROPY * MAX_ANISOTROPY));
  // Undefined at (0, 0), where the ellipse is a circle.
  float angle = 0.5 * atan(xy, difference == 0.0 ? 1e-30 : difference);
  uint pixel = uint(gl_FragCoord.x) * 2749u + uint(gl_FragCoord.y) * 6997u;
  // Frames are steps of the golden ratio, which fill the interval evenly.
  float number = fract(float(hash(pixel) >> 8) / 16777216.0 + 0.6180340 * float(frame));
  float along = 0.5 * sqrt(max(major - minor, 0.0)) * normal_quantile(number);
  return vec3(along * cos(angle), along * sin(angle), 0.5 * sqrt(minor));
}

void main() {
  // The pixel's filter has a standard deviation of half a pixel.
  vec2 shape = vec2(1.0, ASPECT);
  vec3 footprint = round_footprint(dFdx(uv_there) * shape, dFdy(uv_there) * shape);
  vec2 uv = uv_there + footprint.xy / shape;
  float sigma = footprint.z;
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
  if (shown == 1) { color = vec4(uv - floor(uv), sigma, 1.0); return; }
  if (shown == 2) { color = vec4(omega_o, 1.0); return; }
  Seen seen = stage1(uv, sigma, omega_o);
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
  color = vec4(sum, 1.0 - transmittance(uv, sigma, omega_o));
}
