#version 300 es
in vec3 position;
in vec3 normal;
in vec4 tangent;
in vec2 uv;
uniform mat4 view_projection;
uniform vec2 jitter;  // in clip coordinates
out vec3 world;
out vec3 normal_there;
out vec4 tangent_there;
out vec2 uv_there;
void main() {
  world = position;
  normal_there = normal;
  tangent_there = tangent;
  uv_there = uv;
  gl_Position = view_projection * vec4(position, 1.0);
  gl_Position.xy += jitter * gl_Position.w;
}
