"""GLSL of the simulator. Positions are world metres, colours linear RGB until the last lines of ``SHADE``."""

from __future__ import annotations

VERSION = "#version 330\n"

SKY = """
uniform vec3 zenith, horizon, bounce, sun, sun_direction;
vec3 sky(vec3 ray) {
    float up = clamp(ray.z, 0.0, 1.0);
    vec3 color = mix(horizon, zenith, sqrt(up));
    float near_sun = max(dot(ray, sun_direction), 0.0);
    color += sun * 0.05 * pow(near_sun, 24.0);
    return mix(bounce * 0.9, color, smoothstep(-0.06, 0.02, ray.z));
}
"""

FILM = """
uniform vec3 gain;
vec3 film(vec3 c) {
    c *= gain;
    c = (c * (2.51 * c + 0.03)) / (c * (2.43 * c + 0.59) + 0.14);
    return sqrt(clamp(c, 0.0, 1.0));
}
"""

SOLID_VERTEX = (
    VERSION
    + """
uniform mat4 clip_from_world, world_from_model, shadow_from_world;
uniform vec3 axis; uniform vec3 eye;
in vec3 in_position, in_normal; in vec4 in_color, in_surface;
out vec3 to_eye, normal; out vec3 in_shadow; out vec2 grain; out float depth; flat out vec4 color, surface;
void main() {
    vec4 world = world_from_model * vec4(in_position, 1.0);
    normal = mat3(world_from_model) * in_normal;
    to_eye = eye - world.xyz;
    depth = -dot(to_eye, axis);
    // Biased along the normal, against the shadow's stair steps.
    in_shadow = (shadow_from_world * (world + vec4(normal * 0.06, 0.0))).xyz;
    vec2 side = vec2(dot(world.xy, vec2(-in_normal.y, in_normal.x)), world.z);
    grain = abs(in_normal.z) > 0.5 ? world.xy : side;
    color = in_color; surface = in_surface;
    gl_Position = clip_from_world * world;
}
"""
)

SOLID_FRAGMENT = (
    VERSION
    + SKY
    + FILM
    + """
uniform sampler2D noise; uniform sampler2DShadow shadow_map;
uniform float haze; uniform uint instance;
in vec3 to_eye, normal; in vec3 in_shadow; in vec2 grain; in float depth; flat in vec4 color, surface;
layout(location = 0) out vec4 out_color; layout(location = 1) out uvec2 out_truth;
void main() {
    float distance = length(to_eye);
    vec3 view = to_eye / distance;
    vec3 n = normalize(normal);
    float fine = texture(noise, grain * 0.31).r - 0.5, coarse = texture(noise, grain * 0.023).g - 0.5;
    vec3 albedo = color.rgb * color.rgb * (1.0 + 2.0 * surface.x * fine + 2.0 * surface.y * coarse);
    float lit = texture(shadow_map, in_shadow);
    float facing = max(dot(n, sun_direction), 0.0);
    vec3 ambient = mix(bounce, mix(horizon, zenith, 0.6), 0.5 + 0.5 * n.z);
    vec3 c = albedo * (ambient + sun * facing * lit);
    vec3 mirrored = reflect(-view, n);
    float grazing = 1.0 - max(dot(n, view), 0.0);
    float fresnel = mix(0.04, 0.10, surface.w) + 0.9 * grazing * grazing * grazing * grazing * grazing;
    float spark = pow(max(dot(mirrored, sun_direction), 0.0), 90.0) * lit;
    c += color.a * (fresnel * sky(mirrored) + (0.15 + surface.w * 0.5) * spark * sun);
    c += surface.z * color.rgb;
    c = mix(horizon, c, exp(-distance * haze));
    out_color = vec4(film(c), 1.0);
    float units = depth * 256.0 + 0.5;
    out_truth = uvec2(instance, units < 65536.0 ? uint(units) : 0u);
}
"""
)

SKY_VERTEX = (
    VERSION
    + """
uniform mat4 world_from_clip; uniform vec3 eye; out vec3 ray;
void main() {
    vec2 p = vec2((gl_VertexID == 1) ? 3.0 : -1.0, (gl_VertexID == 2) ? 3.0 : -1.0);
    vec4 far = world_from_clip * vec4(p, 1.0, 1.0);
    ray = far.xyz / far.w - eye;
    gl_Position = vec4(p, 1.0, 1.0);
}
"""
)

SKY_FRAGMENT = (
    VERSION
    + SKY
    + FILM
    + """
uniform sampler2D noise; uniform float cloudiness;
in vec3 ray;
layout(location = 0) out vec4 out_color; layout(location = 1) out uvec2 out_truth;
void main() {
    vec3 d = normalize(ray);
    vec3 c = sky(d);
    vec2 p = d.xy / max(d.z + 0.12, 0.05);
    float cloud = 0.6 * texture(noise, p * 0.05).g + 0.4 * texture(noise, p * 0.13 + 0.3).g;
    c = mix(c, horizon * 1.1, clamp((cloud - 0.62 + 0.3 * cloudiness) * 3.0, 0.0, 0.9) * smoothstep(0.0, 0.2, d.z));
    out_color = vec4(film(c), 1.0);
    out_truth = uvec2(0u);
}
"""
)

CONTACT_VERTEX = (
    VERSION
    + """
uniform mat4 clip_from_world;
in vec2 in_corner; in vec4 in_place; in vec2 in_size;
out vec2 place; flat out vec2 half_size;
void main() {
    half_size = 0.5 * in_size;
    place = in_corner * (half_size + 0.6);
    vec2 turned = vec2(in_place.w * place.x - in_place.z * place.y, in_place.z * place.x + in_place.w * place.y);
    gl_Position = clip_from_world * vec4(in_place.xy + turned, 0.016, 1.0);
}
"""
)
"""A soft dark patch under each vehicle: the sky light that it keeps from the road."""

CONTACT_FRAGMENT = (
    VERSION
    + """
in vec2 place; flat in vec2 half_size;
layout(location = 0) out vec4 out_color;
void main() {
    vec2 d = abs(place) - half_size + 0.25;
    float outside = length(max(d, 0.0)) + min(max(d.x, d.y), 0.0);
    out_color = vec4(0.0, 0.0, 0.0, 0.62 * (1.0 - smoothstep(-0.25, 0.65, outside)));
}
"""
)

DEPTH_VERTEX = (
    VERSION
    + """
uniform mat4 clip_from_world, world_from_model;
in vec3 in_position;
void main() { gl_Position = clip_from_world * (world_from_model * vec4(in_position, 1.0)); }
"""
)

DEPTH_FRAGMENT = VERSION + "void main() {}\n"

MASK_FRAGMENT = VERSION + "out vec4 out_mask; void main() { out_mask = vec4(1.0); }\n"
