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
uniform vec3 gain; uniform vec4 lens; uniform vec2 grade;
vec3 film(vec3 c) {
    vec2 p = gl_FragCoord.xy * lens.xy + lens.zw;
    c *= gain * (1.0 - grade.x * dot(p, p));
    c = max(mix(vec3(dot(c, vec3(0.3, 0.59, 0.11))), c, grade.y), 0.0);
    c = (c * (2.51 * c + 0.03)) / (c * (2.43 * c + 0.59) + 0.14);
    return sqrt(clamp(c, 0.0, 1.0));
}
"""

"""``lens``: from pixels to -1..1 across the diagonal. ``grade``: vignetting, saturation."""

SOLID_VERTEX = (
    VERSION
    + """
uniform mat4 clip_from_world, world_from_model, shadow_from_world;
uniform vec3 axis; uniform vec3 eye;
in vec3 in_position, in_normal; in vec4 in_color, in_surface;
out vec3 to_eye, normal, place; out vec3 in_shadow; out vec2 grain; out float depth; flat out vec4 color, surface;
void main() {
    vec4 world = world_from_model * vec4(in_position, 1.0);
    normal = mat3(world_from_model) * in_normal;
    to_eye = eye - world.xyz; place = world.xyz;
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
uniform sampler2D noise, lamp_map; uniform sampler2DShadow shadow_map;
uniform float haze, lamp_scale, window_light, wet; uniform uint instance;
in vec3 to_eye, normal, place; in vec3 in_shadow; in vec2 grain; in float depth; flat in vec4 color, surface;
layout(location = 0) out vec4 out_color; layout(location = 1) out uvec2 out_truth;
void main() {
    float distance = length(to_eye);
    vec3 view = to_eye / distance;
    vec3 n = normalize(normal);
    float fine = texture(noise, grain * 0.31).r - 0.5, coarse = texture(noise, grain * 0.023).g - 0.5;
    vec3 albedo = color.rgb * color.rgb * (1.0 + 2.0 * surface.x * fine + 2.0 * surface.y * coarse);
    float gloss = color.a;
    if (wet > 0.0 && instance == 0u && n.z > 0.9 && place.z < 0.3) {
        // Water darkens the road and mirrors the sky, most in shallow puddles.
        float puddle = wet * smoothstep(-0.05, 0.14, coarse + 0.15 * fine);
        albedo *= 1.0 - 0.45 * wet - 0.2 * puddle;
        gloss = max(gloss, 0.35 * wet + 0.65 * puddle);
        n = normalize(n + vec3(fine, -fine, 0.0) * 0.06 * (1.0 - puddle));
    }
    float lit = texture(shadow_map, in_shadow);
    float facing = max(dot(n, sun_direction), 0.0);
    vec3 ambient = mix(bounce, mix(horizon, zenith, 0.6), 0.5 + 0.5 * n.z);
    vec3 lamps = texture(lamp_map, place.xy * lamp_scale + 0.5).rgb * (n.z > 0.0 ? 0.45 + 0.55 * n.z : 0.45 + 0.2 * n.z);
    vec3 c = albedo * (ambient + sun * facing * lit + lamps);
    vec3 mirrored = reflect(-view, n);
    float grazing = 1.0 - max(dot(n, view), 0.0);
    float fresnel = mix(0.04, 0.10, surface.w) + 0.9 * grazing * grazing * grazing * grazing * grazing;
    float spark = pow(max(dot(mirrored, sun_direction), 0.0), 90.0) * lit;
    c += gloss * (fresnel * (sky(mirrored) + 0.5 * lamps) + (0.15 + surface.w * 0.5) * spark * sun);
    // Panes that glow are lit windows and lamps: they shine by night only.
    c += surface.w > 0.5 ? surface.z * window_light * vec3(1.0, 0.76, 0.46) : surface.z * color.rgb;
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
uniform mat4 clip_from_world; uniform vec3 eye; uniform float haze;
in vec2 in_corner; in vec4 in_place; in vec3 in_size;
out vec2 place; flat out vec2 half_size; flat out float clear;
void main() {
    clear = exp(-distance(eye, vec3(in_place.xy, in_size.z)) * haze);
    half_size = 0.5 * in_size.xy;
    place = in_corner * (half_size + 0.6);
    vec2 turned = vec2(in_place.w * place.x - in_place.z * place.y, in_place.z * place.x + in_place.w * place.y);
    gl_Position = clip_from_world * vec4(in_place.xy + turned, in_size.z + 0.016, 1.0);
}
"""
)
"""A soft dark patch under each vehicle: the sky light that it keeps from the road."""

CONTACT_FRAGMENT = (
    VERSION
    + """
in vec2 place; flat in vec2 half_size; flat in float clear;
layout(location = 0) out vec4 out_color;
void main() {
    vec2 d = abs(place) - half_size + 0.25;
    float outside = length(max(d, 0.0)) + min(max(d.x, d.y), 0.0);
    out_color = vec4(0.0, 0.0, 0.0, 0.62 * clear * (1.0 - smoothstep(-0.25, 0.65, outside)));
}
"""
)

LAMP_VERTEX = (
    VERSION
    + """
uniform float scale;
in vec2 in_corner; in vec4 in_place; in vec4 in_light;
out vec2 local; flat out vec4 light; flat out float height;
void main() {
    // Kind 0: a street lamp lights a disc. Kind 1: head lamps light a strip ahead.
    bool beam = in_light.w > 0.5;
    local = beam ? vec2(17.0 * in_corner.x + 17.0, 7.0 * in_corner.y) : 24.0 * in_corner;
    vec2 forward = vec2(cos(in_place.w), sin(in_place.w));
    vec2 world = in_place.xy + local.x * forward + local.y * vec2(-forward.y, forward.x);
    light = in_light; height = in_place.z;
    gl_Position = vec4(world * 2.0 * scale, 0.0, 1.0);
}
"""
)
"""Light on the ground, seen from above."""

LAMP_FRAGMENT = (
    VERSION
    + """
in vec2 local; flat in vec4 light; flat in float height;
layout(location = 0) out vec4 out_light;
void main() {
    float strength;
    if (light.w > 0.5) {
        float x = max(local.x, 0.3), spread = 0.9 + 0.16 * x;
        float side = exp(-local.y * local.y / (spread * spread));
        strength = side * smoothstep(0.2, 5.0, x) / (1.0 + 0.012 * x * x) * (1.0 - smoothstep(24.0, 34.0, x));
    } else {
        float d2 = dot(local, local);
        strength = height * height * height / pow(d2 + height * height, 1.5) * (1.0 - smoothstep(300.0, 576.0, d2));
    }
    out_light = vec4(light.rgb * strength, 1.0);
}
"""
)

GLOW_VERTEX = (
    VERSION
    + """
uniform mat4 clip_from_world; uniform vec3 eye; uniform float haze; uniform vec2 px;
in vec2 in_corner; in vec4 in_place; in vec4 in_light; in vec4 in_facing;
out vec2 local; flat out vec3 light;
void main() {
    vec3 to_eye = eye - in_place.xyz;
    float distance = length(to_eye);
    vec3 view = to_eye / distance;
    float facing = in_facing.w > 0.5 ? pow(max(dot(view, in_facing.xyz), 0.0), 2.0) : 1.0;
    float spread = in_facing.w > 0.5 ? 1.0 / (1.0 + 0.0004 * distance * distance) : 1.0;
    light = in_light.rgb * facing * exp(-distance * haze) * spread;
    vec4 at = clip_from_world * vec4(in_place.xyz + 0.5 * view, 1.0);
    // A lamp never shrinks below a few pixels: the lens scatters its light.
    vec2 half_size = max(in_place.w * px * 1000.0 / at.w, 5.0 * px) * (facing > 0.01 ? 1.0 : 0.0);
    local = in_corner;
    gl_Position = at + vec4(in_corner * half_size * at.w, 0.0, 0.0);
}
"""
)
"""Halos round lamps. ``px``: one pixel in clip space; ``in_place.w``: radius in px at 1 m with a focal length of 1000 px."""

GLOW_FRAGMENT = (
    VERSION
    + FILM
    + """
in vec2 local; flat in vec3 light;
layout(location = 0) out vec4 out_color;
void main() {
    float r2 = dot(local, local);
    if (r2 > 1.0) discard;
    float fall = (1.0 - r2) * (1.0 - r2);
    vec3 c = light * (0.9 * pow(fall, 6.0) + 0.10 * fall);
    out_color = vec4(film(c), 0.0);
}
"""
)

MIRROR_VERTEX = (
    VERSION
    + """
uniform mat4 clip_from_world; uniform vec3 eye; uniform float haze;
in vec2 in_corner; in vec4 in_place; in vec4 in_light; in vec4 in_facing;
out vec2 local; flat out vec3 light;
void main() {
    // The point of the road where the eye sees the lamp mirrored, drawn out along the line of sight.
    vec2 away = in_place.xy - eye.xy;
    float distance = length(away);
    vec2 along = away / distance, spot = in_place.xy - away * (in_place.z / (in_place.z + eye.z));
    float facing = in_facing.w > 0.5 ? max(-dot(along, in_facing.xy), 0.0) : 1.0;
    light = in_light.rgb * facing * exp(-distance * haze);
    float reach = min(0.05 * distance + 2.0 * in_place.z, 9.0);
    vec2 at = spot + in_corner.x * reach * along + in_corner.y * (0.25 + 0.006 * distance) * vec2(-along.y, along.x);
    local = in_corner;
    gl_Position = clip_from_world * vec4(at, 0.02, 1.0);
}
"""
)
"""Lamps mirrored in a wet road."""

MIRROR_FRAGMENT = (
    VERSION
    + FILM
    + """
in vec2 local; flat in vec3 light;
layout(location = 0) out vec4 out_color;
void main() {
    vec2 d = 1.0 - local * local;
    out_color = vec4(film(light * 0.07 * d.x * d.x * d.y * d.y), 0.0);
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
