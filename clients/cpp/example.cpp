// Sends a frame to a service, and writes the image that the eye receives as PPM to stdout.
//
//     g++ -std=c++17 -O2 example.cpp -o example -lzmq
//     ./example > seen.ppm
//     ./example ENDPOINT PROFILE_JSON WIDTH_PX HEIGHT_PX COLOR_FILE DEPTH_FILE > seen.ppm
//
// The files are raw: color has 3 bytes of sRGB for each pixel, and depth a float in meters, top
// row first.  Without them, the scene is a near checkerboard in front of a far one.

#include <cstdio>
#include <fstream>
#include <iostream>

#include "ocufilter.hpp"

namespace {

struct Scene {
  ocufilter::Camera camera;
  std::vector<std::uint8_t> color;
  std::vector<float> depth_m;
};

Scene checkerboards(int width_px, int height_px) {
  Scene scene{ocufilter::Camera::from_fov(30.0, width_px, height_px), {}, {}};
  for (int y = 0; y < height_px; ++y) {
    for (int x = 0; x < width_px; ++x) {
      const bool is_near = x < width_px / 2;
      const std::uint8_t value = (x / 8 + y / 8) % 2 ? 230 : 25;
      scene.color.insert(scene.color.end(), {value, is_near ? value : std::uint8_t{90}, 60});
      scene.depth_m.push_back(is_near ? 0.5f : 4.0f);
    }
  }
  return scene;
}

template <class T>
std::vector<T> read(const char* path, std::size_t count) {
  std::vector<T> values(count);
  std::ifstream file(path, std::ios::binary);
  const auto size_bytes = static_cast<std::streamsize>(count * sizeof(T));
  if (!file.read(reinterpret_cast<char*>(values.data()), size_bytes))
    throw std::invalid_argument(std::string(path) + " has less than " +
                                std::to_string(size_bytes) + " bytes, or cannot be read");
  return values;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc > 3 && argc != 7) {
    std::cerr << "usage: example [ENDPOINT [PROFILE_JSON [WIDTH_PX HEIGHT_PX COLOR DEPTH]]]\n";
    return 2;
  }
  try {
    Scene scene = checkerboards(320, 180);
    if (argc == 7) {
      scene.camera = ocufilter::Camera::from_fov(30.0, std::stoi(argv[3]), std::stoi(argv[4]));
      const auto n_pixels = std::size_t(scene.camera.width_px) * scene.camera.height_px;
      scene.color = read<std::uint8_t>(argv[5], 3 * n_pixels);
      scene.depth_m = read<float>(argv[6], n_pixels);
    }
    ocufilter::Client client(argc > 1 ? argv[1] : "tcp://127.0.0.1:5577");
    client.set_profile({argc > 2 ? argv[2] : R"({"kind": "preset", "name": "myopia"})",
                        {scene.camera}});
    ocufilter::Frame frame;
    frame.views = {{scene.camera, scene.color, scene.depth_m}};
    frame.focus_dpt = 0.25;
    const ocufilter::Result seen = client.filter(frame);
    for (const std::string& note : seen.notes) std::cerr << note << '\n';
    const ocufilter::Image& image = seen.images[0];
    std::printf("P6\n%d %d\n255\n", image.width_px, image.height_px);
    std::fwrite(image.data(), 1, image.size_bytes(), stdout);
  } catch (const std::exception& error) {
    std::cerr << "example: " << error.what() << '\n';
    return 1;
  }
}
