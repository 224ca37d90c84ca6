#version 300 es
// Exposure and the sRGB curve; left of the dividing line the first picture, right of it the second.
precision highp float;
uniform sampler2D first;
uniform sampler2D second;
uniform float divide;  // in [0, 1]; 1 shows the first alone
uniform float exposure;
uniform vec2 size;
uniform vec3 background;  // linear
in vec2 place;
out vec4 color;
vec4 at(sampler2D image) {
  vec2 texels = vec2(textureSize(image, 0)), p = place * texels - 0.5;
  ivec2 low = ivec2(floor(p)), last = ivec2(texels) - 1;
  vec2 f = p - vec2(low);
  vec4 sum = vec4(0.0);
  for (int k = 0; k < 4; k++) {
    ivec2 step = ivec2(k & 1, k >> 1);
    vec2 w = mix(1.0 - f, f, vec2(step));
    sum += w.x * w.y * texelFetch(image, clamp(low + step, ivec2(0), last), 0);
  }
  return sum;
}
void main() {
  bool right = place.x > divide;
  vec4 found = right ? at(second) : at(first);
  // Values are premultiplied: the background adds what passes through.
  vec3 linear = max(found.rgb * exp2(exposure), vec3(0.0)) + background * (1.0 - clamp(found.a, 0.0, 1.0));
  vec3 low = 12.92 * linear, high = 1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055;
  vec3 curved = min(mix(high, low, vec3(lessThanEqual(linear, vec3(0.0031308)))), vec3(1.0));
  color = vec4(curved, 1.0);
  if (divide < 1.0 && abs(place.x - divide) * size.x < 1.0) color = vec4(1.0);
}
