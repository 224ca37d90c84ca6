#version 300 es
// Running mean of frames.
precision highp float;
uniform sampler2D mean;
uniform sampler2D latest;
uniform float weight;
out vec4 color;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  color = mix(texelFetch(mean, at, 0), texelFetch(latest, at, 0), weight);
}
