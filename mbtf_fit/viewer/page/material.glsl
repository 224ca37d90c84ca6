// Value M(u, sigma, omega_i, omega_o) of a neural material in 1/sr. The formulas are those of material.json;
// layers of the networks and the order of their inputs are generated code (mbtf_fit/viewer/shader.py).

const float PI = 3.14159265358979;

// A position between four texels of a level of a periodic texture.
struct Corners { ivec2 low; ivec2 high; vec2 f; };

// `level`: columns, rows, and the first row of the level in the texture.
Corners corners(ivec3 level, vec2 u) {
  vec2 size = vec2(level.xy);
  vec2 p = vec2(u.x, 1.0 - u.y) * size - 0.5;
  vec2 texel = floor(p);
  vec2 wrapped = texel - size * floor(texel / size);
  ivec2 low = min(ivec2(wrapped), level.xy - 1);
  ivec2 high = low + 1;
  high.x = high.x == level.x ? 0 : high.x;
  high.y = high.y == level.y ? 0 : high.y;
  ivec2 start = ivec2(0, level.z);
  return Corners(low + start, high + start, p - texel);
}

vec4 bilinear(sampler2DArray image, Corners c, int layer) {
  vec4 top = mix(texelFetch(image, ivec3(c.low, layer), 0), texelFetch(image, ivec3(c.high.x, c.low.y, layer), 0), c.f.x);
  vec4 bottom = mix(texelFetch(image, ivec3(c.low.x, c.high.y, layer), 0), texelFetch(image, ivec3(c.high, layer), 0), c.f.x);
  return mix(top, bottom, c.f.y);
}

// Two adjacent levels of a pyramid and the weight of the finer one.
struct Pair { Corners coarse; Corners fine; float weight; };

#define FIND_PAIR(name, LEVELS, COUNT) \
  Pair name(float level, vec2 u) { \
    float l = clamp(level, 0.0, float(COUNT - 1)); \
    int s = max(min(int(l), COUNT - 2), 0); \
    return Pair(corners(LEVELS[s], u), corners(LEVELS[min(s + 1, COUNT - 1)], u), l - float(s)); \
  }

vec4 blended(sampler2DArray image, Pair p, int layer) {
  return mix(bilinear(image, p.coarse, layer), bilinear(image, p.fine, layer), p.weight);
}

FIND_PAIR(pyramid_pair, PYRAMID_LEVELS, PYRAMID_COUNT)

uniform sampler2DArray pyramid_texture;
uniform sampler2DArray offset_texture;
uniform sampler2DArray map_texture;
uniform sampler2DArray horizon_texture;
uniform sampler2DArray transmittance_texture;
uniform sampler2D calibration_texture;
uniform sampler2D node_texture;

// a . (0, 0, 1) of a direction in the frame whose z is `axis`: the shortest rotation that takes axis to z.
vec3 rotate_to_z(vec3 axis, vec3 w) {
  float t = dot(axis.xy, w.xy);
  return vec3(w.xy - axis.xy * (w.z + t / (1.0 + axis.z)), axis.z * w.z + t);
}

#ifdef CALIBRATION_KNOTS
// Factors by light (table 0) or view (table 1), bilinear between levels and cosines.
vec3 calibration(int table, float level, float cosine) {
  float x = clamp(cosine, 0.0, 1.0) * float(CALIBRATION_KNOTS - 1);
  int left = min(int(x), CALIBRATION_KNOTS - 2);
  int s = max(min(int(level), LEVELS - 2), 0), finer = min(s + 1, LEVELS - 1), first = table * LEVELS;
  vec3 coarse = mix(texelFetch(calibration_texture, ivec2(left, first + s), 0).rgb,
                    texelFetch(calibration_texture, ivec2(left + 1, first + s), 0).rgb, x - float(left));
  vec3 fine = mix(texelFetch(calibration_texture, ivec2(left, first + finer), 0).rgb,
                  texelFetch(calibration_texture, ivec2(left + 1, first + finer), 0).rgb, x - float(left));
  return mix(coarse, fine, level - float(s));
}
#endif

#ifdef PLACES
FIND_PAIR(map_pair, MAP_LEVELS, MAP_COUNT)
FIND_PAIR(horizon_pair, HORIZON_LEVELS, HORIZON_COUNT)

// Row of the table of nodes: a cell's surface, or the height of a block's highest vertex
// (mbtf_gen/geometry/height_planes.py). `w` is the fold along the diagonal of a cell.
vec4 node(int index) { return texelFetch(node_texture, ivec2(index & (NODE_COLUMNS - 1), index >> NODE_SHIFT), 0); }

// Nodes that were visited, for measurements.
int visited = 0;

// Height at which the line through uv along omega, towards the viewer, first meets the surface.
float trace(vec2 u, vec3 omega) {
  vec2 size = vec2(HEIGHT_SIZE);
  vec3 d = vec3(-omega.xy * size / vec2(1.0, ASPECT), -omega.z);
  float both = d.x + d.y;
  vec2 over = vec2(abs(d.x) > 1e-18 ? 1.0 / d.x : (d.x >= 0.0 ? 1e18 : -1e18),
                   abs(d.y) > 1e-18 ? 1.0 / d.y : (d.y >= 0.0 ? 1e18 : -1e18));
  float over_both = -(abs(both) > 1e-18 ? 1.0 / both : (both >= 0.0 ? 1e18 : -1e18));
  vec2 position = u * size - 0.5;
  position -= size * floor(position / size);
  ivec2 cell = clamp(ivec2(position), ivec2(0), HEIGHT_SIZE - 1);
  vec2 inside = position - vec2(cell);
  float z = 0.0;
  int level = min(BLOCK_LEVELS, 4), crossings = 0;
  for (int n = 0; n < 4096; n++) {
    visited++;
    int side = 1 << level;
    ivec2 low = cell & ~(side - 1);
    vec2 p = vec2(cell - low) + inside;
    int index = level == 0 ? cell.y * HEIGHT_SIZE.x + cell.x
                           : BLOCK_STARTS[level] + (cell.y >> level) * BLOCK_STRIDES[level] + (cell.x >> level);
    ivec2 extent = min(ivec2(side), HEIGHT_SIZE - low);
    vec4 c = node(index);
    vec2 to = (vec2(d.x >= 0.0 ? float(extent.x) : 0.0, d.y >= 0.0 ? float(extent.y) : 0.0) - p) * over;
    float end = max(min(to.x, to.y), 0.0);
    float here = z - (p.x * c.y + p.y * c.z + c.x), slope = d.z - d.x * c.y - d.y * c.z;
    float across = p.x + p.y - 1.0, fold = max(end * both + across, 0.0) * c.w, diagonal = across * over_both;
    bool passes = diagonal > 0.0 && diagonal < end;
    bool under = passes && diagonal * slope + here <= 0.0;
    bool open = end * slope + here - fold > 0.0 && (level == 0 || here > 0.0) && !under;
    if (!open) {
      if (level > 0) { level--; continue; }
      bool second = across > 0.0 || (across == 0.0 && both > 0.0);
      if (passes && diagonal * slope + here > 0.0) second = !second;
      float bend = second ? c.w : 0.0, t = (here - across * bend) / (both * bend - slope);
      return (t > 0.0 ? min(t, end) : 0.0) * d.z + z;
    }
    vec2 next = end * d.xy + p;
    z += end * d.z;
    ivec2 moved;
    if (to.x <= to.y) {
      moved = ivec2(d.x >= 0.0 ? extent.x : -1, clamp(int(next.y), 0, extent.y - 1));
      inside = vec2(d.x >= 0.0 ? 0.0 : 1.0, next.y - float(moved.y));
    } else {
      moved = ivec2(clamp(int(next.x), 0, extent.x - 1), d.y >= 0.0 ? extent.y : -1);
      inside = vec2(next.x - float(moved.x), d.y >= 0.0 ? 0.0 : 1.0);
    }
    moved += low;
    ivec2 changed = (moved ^ cell) >> (level + 1);
    if ((changed.x | changed.y) != 0) level = min(level + 1, BLOCK_LEVELS);
    ivec2 wrapped = moved;
    if (moved.x < 0) wrapped.x = HEIGHT_SIZE.x - 1; else if (moved.x >= HEIGHT_SIZE.x) wrapped.x = 0;
    if (moved.y < 0) wrapped.y = HEIGHT_SIZE.y - 1; else if (moved.y >= HEIGHT_SIZE.y) wrapped.y = 0;
    if ((wrapped.x != moved.x || wrapped.y != moved.y) && ++crossings > MAX_CROSSINGS) break;
    cell = wrapped;
  }
  return z;
}

// Error function (Abramowitz and Stegun 1964, 7.1.26), to 1.5e-7.
float erf(float x) {
  float t = 1.0 / (1.0 + 0.3275911 * abs(x));
  float y = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
  return sign(x) * (1.0 - y * exp(-x * x));
}

// Share of the footprint from which the light is visible: horizons of two adjacent azimuths share a texel.
float visibility(Pair p, vec3 omega_i) {
  float azimuth = dot(omega_i.xy, omega_i.xy) > 0.0 ? atan(omega_i.y, omega_i.x) * (float(AZIMUTHS) / (2.0 * PI)) : 0.0;
  azimuth -= float(AZIMUTHS) * floor(azimuth / float(AZIMUTHS));
  int first = min(int(azimuth), AZIMUTHS - 1);
  vec4 found = blended(horizon_texture, p, first);
  vec2 mean_square = mix(found.xy, found.zw, azimuth - float(first));
  float variance = max(mean_square.y - mean_square.x * mean_square.x, 0.0) + HORIZON_VARIANCE;
  float elevation = asin(clamp(omega_i.z, 0.0, 1.0));
  return 0.5 + 0.5 * erf((elevation - mean_square.x) / sqrt(2.0 * max(variance, LEAST_VARIANCE)));
}

// A traced place of the footprint, and the filtered maps there.
struct Place { Pair horizons; vec3 normal; float square; vec3 base; float alpha2; float metallic; };

float masking(float alpha2, float c) { return sqrt(1.0 + alpha2 * (1.0 / (c * c) - 1.0)); }

// Irradiance, normal's x and y; single scattering in `core`.
vec3 shade(Place at, vec3 omega_i, vec3 omega_o, out vec3 core) {
  float light = dot(at.normal, omega_i);
  float irradiance = visibility(at.horizons, omega_i) * max(light, 0.0) / omega_i.z;
  vec3 value = at.base / PI;
#ifdef GLOSSY
  light = max(light, LEAST_LIGHT);
  float view = max(dot(at.normal, omega_o), LEAST_VIEW);
  vec3 h = normalize(omega_i + omega_o);
  float c = max(dot(at.normal, h), 0.0), inside = c * c * (at.alpha2 - 1.0) + 1.0;
  float facets = at.alpha2 / (PI * inside * inside);
  float rest = 1.0 - clamp(dot(omega_o, h), 0.0, 1.0), schlick = rest * rest * rest * rest * rest;
  float lobe = facets / (2.0 * (masking(at.alpha2, light) + masking(at.alpha2, view)) * light * view);
  vec3 f0 = mix(vec3(DIELECTRIC), at.base, at.metallic);
  value = (1.0 - at.metallic) * value + (f0 + (1.0 - f0) * schlick) * lobe;
#endif
  core = irradiance * value;
  return vec3(irradiance, at.normal.xy);
}
#endif

// What does not depend on the light (stage 1).
struct Seen {
  vec2 u;
  float level;
  float height;
  vec4 features[FEATURE_VECTORS];
#ifdef PLACES
  Place places[PLACES];
#endif
#ifdef CALIBRATION_KNOTS
  vec3 by_view;
#endif
};

//GENERATED

Seen stage1(vec2 u, float sigma, vec3 omega_o) {
  Seen seen;
  u -= floor(u);
  seen.u = u;
  seen.level = clamp(-log2(2.0 * sigma), 0.0, float(LEVELS - 1));
  seen.height = 0.0;
  vec2 moved = u;
#ifdef OFFSET_OUTPUTS
  Corners c = corners(ivec3(OFFSET_SIZE, 0), u);
  vec2 r = OFFSET_SCALE * offset_network(c, omega_o);
  moved += r / vec2(1.0, ASPECT);
#endif
#ifdef PLACES
  float footprint = 0.5 * exp2(-seen.level), flat_length = length(omega_o.xy);
  vec2 along = flat_length > 0.0 ? omega_o.xy / flat_length : vec2(1.0, 0.0), across = vec2(-along.y, along.x);
  for (int k = 0; k < PLACES; k++) {
    vec2 at = u + footprint * (PLACE_OFFSETS[k].x * across + PLACE_OFFSETS[k].y * along) / vec2(1.0, ASPECT);
    float z = trace(at, omega_o);
    vec2 hit = at + z / omega_o.z * omega_o.xy / vec2(1.0, ASPECT);
    float l = seen.level + PLACES_FINER;
    Pair p = map_pair(l, hit);
    vec4 a = blended(map_texture, p, 0), b = blended(map_texture, p, 1);
    Place place;
    place.horizons = horizon_pair(l, hit);
    place.normal = normalize(vec3(-a.xy, 1.0));
    place.square = a.z;
    place.base = vec3(a.w, b.xy);
    place.alpha2 = clamp(b.z + max(a.z - dot(a.xy, a.xy), 0.0) + LIGHT_WIDTH * LIGHT_WIDTH, ALPHA2_LOW, ALPHA2_HIGH);
    place.metallic = b.w;
    seen.places[k] = place;
    seen.height += z / float(PLACES);
  }
  int s = max(min(int(seen.level), LEVELS - 2), 0);
  float weight = mix(DEPTH_WEIGHTS[s], DEPTH_WEIGHTS[min(s + 1, LEVELS - 1)], seen.level - float(s));
  moved += weight * seen.height / omega_o.z * omega_o.xy / vec2(1.0, ASPECT);
#endif
  Pair p = pyramid_pair(seen.level, moved);
#ifdef CONCATENATE
  bool odd = (int(min(seen.level, float(max(LEVELS - 2, 0)))) & 1) == 1;
  for (int k = 0; k < PYRAMID_LAYERS; k++) {
    vec4 one = (1.0 - p.weight) * bilinear(pyramid_texture, p.coarse, k);
    vec4 two = p.weight * bilinear(pyramid_texture, p.fine, k);
    seen.features[k] = odd ? two : one;
    seen.features[PYRAMID_LAYERS + k] = odd ? one : two;
  }
#else
  for (int k = 0; k < PYRAMID_LAYERS; k++) seen.features[k] = blended(pyramid_texture, p, k);
#endif
#ifdef CALIBRATION_KNOTS
  seen.by_view = calibration(1, seen.level, omega_o.z);
#endif
  return seen;
}

// Value for light from omega_i (stage 2), at least 0.
vec3 stage2(Seen seen, vec3 omega_i, vec3 omega_o) {
  vec3 half_vector = normalize(omega_i + omega_o), known = vec3(0.0), core = vec3(0.0);
#ifdef PLACES
  for (int k = 0; k < PLACES; k++) {
    vec3 scattered;
    known += shade(seen.places[k], omega_i, omega_o, scattered) / float(PLACES);
    core += scattered / float(PLACES);
  }
#endif
  vec3 value = decode(seen, omega_i, omega_o, half_vector, known, core);
#ifdef CALIBRATION_KNOTS
  value *= seen.by_view * calibration(0, seen.level, omega_i.z);
#endif
  return max(value, vec3(0.0));
}

// Transparent fraction of the footprint.
float transmittance(vec2 u, float sigma, vec3 omega_o) {
#ifdef TRANSMITTANCE_COUNT
  float level = clamp(-log2(2.0 * sigma), 0.0, float(LEVELS - 1));
  int s = max(min(int(level), TRANSMITTANCE_COUNT - 2), 0);
  u -= floor(u);
  Pair p = Pair(corners(TRANSMITTANCE_LEVELS[s], u),
                corners(TRANSMITTANCE_LEVELS[min(s + 1, TRANSMITTANCE_COUNT - 1)], u), level - float(s));
  vec4 a = blended(transmittance_texture, p, 0), b = blended(transmittance_texture, p, 1);
  vec2 w = omega_o.xy;
  return clamp(a.x + a.y * w.x + a.z * w.y + a.w * w.x * w.x + b.x * w.x * w.y + b.y * w.y * w.y, 0.0, 1.0);
#else
  return 0.0;
#endif
}
