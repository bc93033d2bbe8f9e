// The GLM adapters and this toolkit's camera maths against glm's own: lookAt, frustum, project, unProject, inverse.
#define GSF_USE_GLM
#define GSFIXER_IMPLEMENTATION
#include "gsfixer.h"
#include "test.h"

#include <glm/gtc/matrix_transform.hpp>
#include <glm/gtc/quaternion.hpp>

static gsf_camera random_camera(uint64_t* seed) {
    gsf_camera camera;
    memset(&camera, 0, sizeof camera);
    camera.width = 640;
    camera.height = 360;
    camera.fx = test_random_in(seed, 200, 900);
    camera.fy = test_random_in(seed, 200, 900);
    camera.cx = test_random_in(seed, 250, 390);
    camera.cy = test_random_in(seed, 140, 220);
    glm::dvec3 eye, to;
    for (int k = 0; k < 3; k++) {
        eye[k] = test_random_in(seed, -5, 5);
        to[k] = test_random_in(seed, -1, 1);
    }
    gsf_from_glm_view(glm::lookAt(eye, to, glm::dvec3(0.1, 1.0, -0.2)), &camera);
    double center[3];
    gsf_get_camera_center(&camera, center);
    for (int k = 0; k < 3; k++) CHECK_NEAR(center[k], eye[k], 1e-12);
    double u = 0, v = 0, depth = 0; // the point looked at lies in the middle, before the camera
    const double target[3] = {to.x, to.y, to.z};
    CHECK(gsf_project_point(&camera, target, &u, &v, &depth));
    CHECK_NEAR(u, camera.cx, 1e-9);
    CHECK_NEAR(v, camera.cy, 1e-9);
    CHECK_NEAR(depth, glm::length(to - eye), 1e-12);
    return camera;
}

int main() {
    gsf_context ctx;
    test_context_init(&ctx);
    uint64_t seed = 11;
    for (int i = 0; i < 200; i++) {
        const gsf_camera camera = random_camera(&seed);
        CHECK_OK(&ctx, gsf_check_camera(&ctx, &camera));

        // matrices: copies, products, rigid inverse
        const glm::dmat4 w2c = gsf_to_glm_w2c(camera);
        double back[16], c2w[16], product[16];
        gsf_from_glm(w2c, back);
        CHECK(memcmp(back, camera.w2c, sizeof back) == 0);
        gsf_get_camera_c2w(&camera, c2w);
        const glm::dmat4 inverse = glm::inverse(w2c), other = glm::translate(inverse, glm::dvec3(1, 2, 3));
        double wide[16];
        gsf_from_glm(inverse, wide);
        test_compare("rigid inverse", c2w, wide, 16, 1e-12);
        gsf__mat4_mul(camera.w2c, &other[0][0], product);
        gsf_from_glm(w2c * other, wide);
        test_compare("product", product, wide, 16, 1e-12);
        gsf_camera same = camera;
        gsf_set_camera_c2w(&same, c2w);
        test_compare("set_c2w", same.w2c, camera.w2c, 16, 1e-12);
        // rotation through a glm quaternion and back
        const glm::dmat4 turned = glm::mat4_cast(glm::quat_cast(glm::dmat3(w2c)));
        for (int c = 0; c < 3; c++)
            for (int r = 0; r < 3; r++) CHECK_NEAR(turned[c][r], camera.w2c[4 * c + r], 1e-12);

        // projection: glm::project counts rows from the bottom
        const glm::dmat4 view = gsf_to_glm_view(camera), projection = gsf_to_glm_projection(camera, 0.1, 100.0);
        const glm::dvec4 viewport(0, 0, camera.width, camera.height);
        const glm::dvec3 local(test_random_in(&seed, -2, 2), test_random_in(&seed, -2, 2),
                               test_random_in(&seed, 0.5, 9));
        const glm::dvec3 world(inverse * glm::dvec4(local, 1.0));
        const glm::dvec3 window = glm::project(world, view, projection, viewport);
        const double point[3] = {world.x, world.y, world.z};
        double u = 0, v = 0, depth = 0;
        CHECK(gsf_project_point(&camera, point, &u, &v, &depth));
        CHECK_NEAR(u, window.x, 1e-9);
        CHECK_NEAR(camera.height - v, window.y, 1e-9);
        CHECK_NEAR(depth, local.z, 1e-12);
        const glm::dvec3 again = glm::unProject(window, view, projection, viewport);
        CHECK_NEAR(glm::length(again - world), 0.0, 1e-8);
        // a point behind the camera
        const glm::dvec3 behind(inverse * glm::dvec4(0.0, 0.0, -1.0, 1.0));
        const double hidden[3] = {behind.x, behind.y, behind.z};
        CHECK(!gsf_project_point(&camera, hidden, &u, &v, &depth));

        // the same projection as glm::frustum of the image borders on the near plane
        const double near_plane = 0.1, l = -camera.cx / camera.fx, r = (camera.width - camera.cx) / camera.fx;
        const double t = camera.cy / camera.fy, b = -(camera.height - camera.cy) / camera.fy;
        const glm::dmat4 frustum =
            glm::frustum(l * near_plane, r * near_plane, b * near_plane, t * near_plane, near_plane, 100.0);
        gsf_from_glm(frustum, wide);
        gsf_from_glm(projection, back);
        test_compare("projection", back, wide, 16, 1e-12);
        gsf_camera read = camera;
        read.fx = read.fy = read.cx = read.cy = 0.0;
        gsf_from_glm_projection(frustum, camera.width, camera.height, &read);
        CHECK_NEAR(read.fx, camera.fx, 1e-9);
        CHECK_NEAR(read.fy, camera.fy, 1e-9);
        CHECK_NEAR(read.cx, camera.cx, 1e-9);
        CHECK_NEAR(read.cy, camera.cy, 1e-9);
        // the view matrix round trip
        gsf_from_glm_view(view, &read);
        test_compare("view", read.w2c, camera.w2c, 16, 1e-15);
    }
    return test_report();
}
