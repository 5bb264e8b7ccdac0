// PCL's NDT and ICP on two clouds of x y z text lines: pcl METHOD SIZE SOURCE TARGET prints milliseconds and the 4x4 pose.
#include <chrono>
#include <fstream>
#include <iostream>
#include <string>

#include <pcl/point_types.h>
#include <pcl/registration/icp.h>
#include <pcl/registration/ndt.h>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;

Cloud::Ptr read(const char* path) {
  Cloud::Ptr cloud(new Cloud);
  std::ifstream file(path);
  for (pcl::PointXYZ p; file >> p.x >> p.y >> p.z;) cloud->push_back(p);
  return cloud;
}

int main(int argc, char** argv) {
  if (argc != 5) return 1;
  const std::string method = argv[1];
  const double size = std::stod(argv[2]);
  const Cloud::Ptr source = read(argv[3]), target = read(argv[4]);
  Cloud aligned;
  Eigen::Matrix4f T;
  const auto began = std::chrono::steady_clock::now();
  if (method == "ndt") {
    pcl::NormalDistributionsTransform<pcl::PointXYZ, pcl::PointXYZ> ndt;
    ndt.setResolution(size);
    ndt.setStepSize(0.1);
    ndt.setTransformationEpsilon(1e-6);  // compared with the squared step
    ndt.setMaximumIterations(50);
    ndt.setInputTarget(target);
    ndt.setInputSource(source);
    ndt.align(aligned);
    T = ndt.getFinalTransformation();
  } else {
    pcl::IterativeClosestPoint<pcl::PointXYZ, pcl::PointXYZ> icp;
    icp.setMaxCorrespondenceDistance(size);
    icp.setMaximumIterations(100);
    icp.setTransformationEpsilon(1e-9);
    icp.setInputTarget(target);
    icp.setInputSource(source);
    icp.align(aligned);
    T = icp.getFinalTransformation();
  }
  const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - began;
  std::cout << took.count() << "\n" << T << std::endl;
}
